"""What the fields of a settings dataclass mean, for help texts and pages."""

import ast
import inspect
import textwrap
from dataclasses import MISSING, fields
from functools import cache


@cache
def field_docstrings(kind: type) -> dict[str, str]:
    """The string below each field of a dataclass, which Python itself throws away."""
    body = ast.parse(textwrap.dedent(inspect.getsource(kind))).body[0]
    assert isinstance(body, ast.ClassDef)
    found = {}
    for field, text in zip(body.body, body.body[1:], strict=False):
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name) and isinstance(text, ast.Expr):
            found[field.target.id] = " ".join(str(ast.literal_eval(text.value)).split())
    return found


def described(kind: type) -> str:
    """A settings dataclass as text: what it is, and each field with its default and meaning."""
    lines = [f"{kind.__name__}: {inspect.getdoc(kind) or ''}"]
    texts = field_docstrings(kind)
    for field in fields(kind):
        plain = field.default is not MISSING and not isinstance(field.default, tuple)
        default = f" = {field.default}" if plain else ""
        lines.append(
            textwrap.fill(
                f"{field.name}{default}: {texts.get(field.name, '')}",
                110,
                initial_indent="  ",
                subsequent_indent="      ",
            )
        )
    return "\n".join(lines)
