"""Safe expansion of xacro: expressions are evaluated without Python's `eval`, which would run arbitrary code.

Xacro passes the content of `${...}` and `$(eval ...)` to `eval` with few restrictions. Here an expression consists of
numbers, strings, lists, comparisons, properties and the functions of this module; everything else is rejected.
"""

import ast
import math
import operator
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any
from xml.dom import minidom

from ..errors import RobotError
from ..files.reading import CALIBRATION, ROBOT, parse_yaml, read_text

_LONGEST = 100_000
"""Maximum length of a string or list in an expression."""
_LARGEST = 2.0**63
"""Maximum integer in an expression."""
_MAX_EXPRESSION_LENGTH = 2_000
LIBRARIES = {"expanded": ("xacro", "xacrodoc")}
"""Function -> modules to import before the memory limit applies."""
_DECLARES = re.compile(r"<!(?:DOCTYPE|ENTITY)", re.IGNORECASE)

_BINARY: dict[type[ast.operator], Callable[[Any, Any], Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.FloorDiv: operator.floordiv,
    ast.Mod: operator.mod,
    ast.Pow: lambda base, exponent: float(base) ** float(exponent),
}
_UNARY: dict[type[ast.unaryop], Callable[[Any], Any]] = {
    ast.USub: operator.neg,
    ast.UAdd: operator.pos,
    ast.Not: operator.not_,
}
_COMPARISONS: dict[type[ast.cmpop], Callable[[Any, Any], bool]] = {
    ast.Eq: operator.eq,
    ast.NotEq: operator.ne,
    ast.Lt: operator.lt,
    ast.LtE: operator.le,
    ast.Gt: operator.gt,
    ast.GtE: operator.ge,
    ast.In: lambda item, where: item in where,
    ast.NotIn: lambda item, where: item not in where,
    ast.Is: operator.is_,
    ast.IsNot: operator.is_not,
}
_OF_MATH = "acos asin atan atan2 ceil cos degrees exp fabs floor fmod hypot log pow radians sin sqrt tan".split()
_FUNCTIONS: dict[str, Callable[..., Any]] = {
    **{function.__name__: function for function in (abs, bool, float, int, len, max, min, round, str)},
    **{name: getattr(math, name) for name in _OF_MATH},
}
_OF_TEXTS = ("lower", "upper", "strip")
_MESSAGES = ("message", "warning", "error")


def expanded(path: Path, packages: dict[str, str], arguments: dict[str, str]) -> str:
    """Expand a model to a URDF. Only for a child process, since xacro is patched to use the expressions of this module.

    Raises:
        Exception: the model cannot be expanded; an exception of xacro or of `Expression.value`.
    """
    import xacro  # noqa: PLC0415 - an extra
    import xacrodoc  # noqa: PLC0415
    from xacro import substitution_args  # noqa: PLC0415

    def parse_file(content: Any, filename: str | None = None) -> Any:
        if content is None:
            content = read_text(Path(xacro.root_dir or "", filename or ""), ROBOT)
        if not isinstance(content, str):
            return content  # The value is already parsed.
        if _DECLARES.search(content):
            raise RobotError(f"{filename or 'the model'} declares a document type or entities, which are not allowed")
        return minidom.parseString(content)

    def refused(text: str, context: Any) -> str:
        raise RobotError(f"$(eval {text}) is not supported; write ${{...}}")

    def evaluate(text: str, symbols: Mapping[str, Any], local: Any = None) -> Any:
        return Expression(symbols, xacro.abs_filename_spec).value(text)

    changed: Any = xacro
    changed.safe_eval, changed.parse, substitution_args._eval = evaluate, parse_file, refused
    xacrodoc.packages.update_package_cache(packages)
    model = xacrodoc.XacroDoc.from_string(read_text(path, ROBOT), subargs=arguments, resolve_packages=False)
    return model.to_urdf_string()


class Expression:
    """Evaluator of xacro expressions."""

    def __init__(self, symbols: Mapping[str, Any], path_of: Callable[[str], str]) -> None:
        self._symbols, self._path_of = symbols, path_of

    def value(self, text: str) -> Any:
        """Evaluate an expression.

        Raises:
            RobotError: the expression contains an unsupported element.
            SyntaxError, TypeError, ValueError, ArithmeticError, LookupError: the expression is invalid, or has no
                value.
        """
        if len(text) > _MAX_EXPRESSION_LENGTH:
            raise RobotError(f"an expression is longer than {_MAX_EXPRESSION_LENGTH:,} characters")
        return self._of(ast.parse(text.strip(), mode="eval").body)

    def _of(self, node: ast.expr) -> Any:
        result = self._calculated(node)
        if isinstance(result, int) and abs(result) > _LARGEST:
            raise RobotError("an integer in an expression has more than 64 bits")
        if isinstance(result, str | list) and len(result) > _LONGEST:
            raise RobotError(f"a string in an expression is longer than {_LONGEST} characters")
        return result

    def _calculated(self, node: ast.expr) -> Any:
        match node:
            case ast.Constant(value=bool() | int() | float() | str() | None):
                result = node.value
            case ast.Name(id=name):
                result = self._symbol(name)
            case ast.List() | ast.Tuple():
                result = [self._of(element) for element in node.elts]
            case ast.UnaryOp(op=op, operand=operand) if type(op) in _UNARY:
                result = _UNARY[type(op)](self._of(operand))
            case ast.BinOp(left=left, op=op, right=right) if type(op) in _BINARY:
                result = _binary(op, self._of(left), self._of(right))
            case ast.BoolOp(op=op, values=values):
                result = self._first(values, isinstance(op, ast.Or))
            case ast.Compare():
                result = self._comparison(node)
            case ast.IfExp(test=test, body=body, orelse=other):
                result = self._of(body if self._of(test) else other)
            case ast.Subscript(value=value, slice=place):
                result = self._of(value)[self._of(place)]
            case ast.Attribute(value=value, attr=name):
                result = self._entry(value, name)
            case ast.Call(func=function, args=arguments, keywords=[]):
                result = self._call(function, arguments)
            case _:
                raise RobotError(f"the expression {ast.unparse(node)!r} is not supported")
        return result

    def _symbol(self, name: str) -> Any:
        value = self._symbols[name]
        if not isinstance(value, str | bool | int | float | list | tuple | Mapping | None):
            raise RobotError(f"{name!r} is not a property, or has no value")
        return value

    def _entry(self, value: ast.expr, name: str) -> Any:
        if isinstance(value, ast.Name) and value.id == "math" and name in ("pi", "e"):
            return getattr(math, name)
        entries = self._of(value)
        if not isinstance(entries, Mapping):
            raise RobotError(f"{ast.unparse(value)!r} has no entries, so it has no {name!r}")
        return entries[name]

    def _first(self, values: list[ast.expr], wanted: bool) -> Any:
        """First operand with the truth value `wanted`, else the last operand: the value of `or` (True) and `and`
        (False)."""
        result: Any = None
        for value in values:
            result = self._of(value)
            if bool(result) is wanted:
                break
        return result

    def _comparison(self, node: ast.Compare) -> bool:
        values = [self._of(value) for value in (node.left, *node.comparators)]
        pairs = zip(values, node.ops, values[1:], strict=False)
        return all(_COMPARISONS[type(op)](left, right) for left, op, right in pairs)

    def _call(self, function: ast.expr, arguments: list[ast.expr]) -> Any:
        values = [self._of(argument) for argument in arguments]
        match function:
            case ast.Name(id=name) | ast.Attribute(value=ast.Name(id="math"), attr=name) if name in _FUNCTIONS:
                return _FUNCTIONS[name](*values)
            case ast.Name(id="load_yaml") | ast.Attribute(value=ast.Name(id="xacro"), attr="load_yaml"):
                return parse_yaml(read_text(Path(self._path_of(str(*values))), CALIBRATION))
            case ast.Attribute(value=ast.Name(id="xacro"), attr=name) if name in _MESSAGES:
                return ""
            case ast.Attribute(value=value, attr=name) if name in _OF_TEXTS:
                return getattr(str(self._of(value)), name)(*values)
        raise RobotError(f"the function {ast.unparse(function)!r} is not allowed in a model")


def _binary(op: ast.operator, left: Any, right: Any) -> Any:
    # Repetition and formatting are not allowed, since they can produce arbitrarily long strings.
    if not isinstance(op, ast.Add) and not (isinstance(left, int | float) and isinstance(right, int | float)):
        raise TypeError(f"{type(op).__name__} requires numbers")
    return _BINARY[type(op)](left, right)
