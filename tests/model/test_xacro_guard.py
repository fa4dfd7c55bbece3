"""Models in xacro run no code, read no special files and come to an end."""

import os
from pathlib import Path

import pytest

from carts_core.errors import RobotError
from carts_core.files.decoding import decoded
from carts_core.model.xacro_guard import Expression, expanded

XACRO = '<robot xmlns:xacro="http://www.ros.org/wiki/xacro" name="x">'
SYMBOLS = {"PI": 3.5, "tip": "093", "table": {"400093": {"tip": "093"}}, "f": len, "type": type}
ESCAPES = {
    "comprehension": "[[c for c in ().__class__.__base__.__subclasses__() if c.__name__ == '_wrap_close'][0]"
    ".__init__.__globals__['system']('touch FOLDER/PWNED') for _ in [1]]",
    "lambda": "(lambda: ().__class__)()",
    "attribute": "().__class__.__base__",
    "type": "python.vars(python.type)['__subclasses__'](python.type(1))",
    "property": "f",
    "called property": "f('a')",
    "format": "'{0.__class__}'.format(1)",
    "keyword": "sorted([1], key=len)",
    "f-string": "f'{PI.__class__}'",
    "walrus": "(x := 1)",
    "power of ten": "10 ** 10 ** 10",
    "long text": "'a' * 10 ** 10",
    "formatted text": "'%1000000000d' % 1",
    "large number": "int('9' * 3)" + " * 10000000000000000000",
    "nested": "(" * 300 + "1" + ")" * 300,
    "long": "1+" * 5_000 + "1",
}


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("-PI / 2", -1.75),
        ("str(tip) == '093' or False", True),
        ("str(tip).lower() not in ['true', '1']", True),
        ("table[str(400093)]['tip']", "093"),
        ("table['400093'].tip", "093"),
        ("xacro.message('Using ' + tip) or False", False),
        ("1 if PI > 3 and PI < 4 else 2", 1),
        ("cos(0) + math.sin(0) + max(1, 2)", 3.0),
        ("2 ** 3", 8.0),
        ("round(math.pi, 2)", 3.14),
    ],
)
def test_expressions_of_models_have_the_values_that_python_gives_them(text: str, value: object) -> None:
    assert Expression(SYMBOLS, str).value(text) == value


@pytest.mark.parametrize("name", ESCAPES)
def test_other_expressions_are_refused(name: str) -> None:
    with pytest.raises((RobotError, SyntaxError, TypeError, ArithmeticError)):
        Expression(SYMBOLS, str).value(ESCAPES[name])


def expand(text: str) -> str:
    Path("model.xacro").write_text(f"{XACRO}{text}</robot>".replace("FOLDER", os.getcwd()))
    return decoded(expanded, Path("model.xacro").absolute(), {}, {})


def bomb(levels: int) -> str:
    macros = ['<xacro:macro name="m0"><link name="a"/></xacro:macro>']
    macros += [
        f'<xacro:macro name="m{level}"><xacro:m{level - 1}/><xacro:m{level - 1}/></xacro:macro>'
        for level in range(1, levels)
    ]
    return "".join(macros) + f"<xacro:m{levels - 1}/>"


HOSTILE = {
    "expression": f'<link name="${{{ESCAPES["comprehension"]}}}"/>',
    "eval": "<xacro:arg name='a' default=\"$(eval open('FOLDER/PWNED', 'w'))\"/><link name='$(arg a)'/>",
    "property": '<xacro:property name="p" value="${python.type}"/><link name="${p}"/>',
    "pipe": '<xacro:include filename="FOLDER/pipe"/>',
    "device": '<xacro:include filename="/dev/zero"/>',
    "table that is a pipe": "<xacro:property name='t' value=\"${xacro.load_yaml('FOLDER/pipe')}\"/><link name='${t}'/>",
    "table with code": "<link name=\"${xacro.load_yaml('FOLDER/table.yaml')}\"/>",
    "entities": '<xacro:include filename="FOLDER/entities.xacro"/>',
    "itself": '<xacro:include filename="FOLDER/itself.xacro"/>',
    "bomb": bomb(40),
}


@pytest.mark.timeout(60)
@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_models_are_refused(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    os.mkfifo("pipe")
    Path("table.yaml").write_text(f'a: !!python/object/apply:os.system ["touch {tmp_path}/PWNED"]\n')
    Path("entities.xacro").write_text(f'<!DOCTYPE r [<!ENTITY a "{"x" * 99}">]>{XACRO}&a;</robot>')
    Path("itself.xacro").write_text(f'{XACRO}<xacro:include filename="{tmp_path}/itself.xacro"/></robot>')
    # What xacro makes of an error is an exception of its own; `dvrk_urdf` makes a `RobotError` of any.
    with pytest.raises(Exception, match=r"."):
        expand(HOSTILE[name])
    assert not Path("PWNED").exists()
