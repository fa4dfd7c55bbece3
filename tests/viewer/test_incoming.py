"""What a tab may send; a real viewer under fire is in test_hostile.py."""

import random
from typing import Any

import msgspec
import pytest
from viser import _messages as messages

from carts_viewer.transport.guard import refusal

WIDGETS = {"slider": 1.5, "frame": 3, "box": True, "text": "a", "colour": (1, 2, 3)}


def _refusal(data: Any) -> str | None:
    packed = data if isinstance(data, bytes | str) else msgspec.msgpack.encode(data)
    return refusal(packed, WIDGETS.get)


def _update(element: str, value: Any, **more: Any) -> dict[str, Any]:
    return {"type": "GuiUpdateMessage", "uuid": element, "updates": {"value": value}, **more}


@pytest.mark.parametrize(
    ("element", "value"),
    [
        ("slider", 2.5),
        ("slider", 2),
        ("slider", -1e9),
        ("frame", 2),
        ("frame", 2.0),
        ("box", False),
        ("text", "ä" * 999),
    ],
)
def test_a_value_of_the_widgets_own_kind_is_taken(element: str, value: Any) -> None:
    assert _refusal(_update(element, value)) is None


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf"), 1e300, -1e17, 2**63])
@pytest.mark.parametrize("element", ["slider", "frame"])
def test_a_number_that_is_none_or_beyond_all_range_is_refused(element: str, value: float) -> None:
    assert _refusal(_update(element, value)) == "a number out of all range"


@pytest.mark.parametrize(
    ("element", "value"),
    [
        *(("slider", value) for value in ("nan", "9" * 4000, True, None, [1.0], {"a": 1}, b"1")),
        *(("frame", value) for value in ("1", False, [])),
        *(("text", value) for value in (1, 1.0, True, None, ["a"])),
        *(("box", value) for value in (1, "True", None)),
        *(("colour", value) for value in (1, "a", [1, 2, 3])),
        *(("no such widget", value) for value in (1, "a", True)),
    ],
)
def test_a_value_of_another_kind_is_refused(element: str, value: Any) -> None:
    assert _refusal(_update(element, value))


@pytest.mark.parametrize(
    "name", ["removed", "sync_cb", "update_cb", "uuid", "disabled", "label", "max", "options", "is_button", "content"]
)
def test_only_the_value_of_a_widget_can_be_set(name: str) -> None:
    assert _refusal({"type": "GuiUpdateMessage", "uuid": "text", "updates": {name: "a"}})
    assert _refusal({"type": "GuiUpdateMessage", "uuid": "text", "updates": {"value": "a", name: "a"}})
    assert _refusal(_update("text", "a", **{name if name != "uuid" else "id": "a"}))


TAKEN = {"GuiUpdateMessage", "CommandTriggerMessage", "ViewerCameraMessage"}
ALL_OF_VISER = sorted(kind.__name__ for kind in messages.Message.get_subclasses())


@pytest.mark.parametrize("name", [name for name in ALL_OF_VISER if name not in TAKEN])
def test_every_other_message_that_the_toolkit_knows_is_refused(name: str) -> None:
    assert _refusal({"type": name, "uuid": "text"})


def test_the_toolkit_still_knows_the_messages_that_are_taken_and_those_that_are_dangerous() -> None:
    assert set(ALL_OF_VISER) >= TAKEN | {"ShareUrlRequest", "FileTransferStartUpload", "FileTransferPart"}


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\xc1",
        b"\x93\x01\x02",
        "text",
        b"\x81\xa4type\xa2\xff\xfe",
        b"\x82\xa1a" + b"\x91" * 200_000 + b"\xc0\xa4type\xb0GuiUpdateMessage",
        msgspec.msgpack.encode(_update("text", "a")) + b"\x00",
        msgspec.msgpack.encode([_update("text", "a")]),
        msgspec.msgpack.encode({"uuid": "text"}),
    ],
    ids=lambda data: repr(data[:20]),
)
def test_what_is_no_message_at_all_is_refused(data: bytes | str) -> None:
    assert _refusal(data)


def test_no_bytes_whatever_raise_anything_else() -> None:
    dice, whole = random.Random(0), msgspec.msgpack.encode(_update("slider", 2.5))
    refused = 0
    for _ in range(5000):
        data = bytearray(whole)
        for _ in range(dice.randrange(1, 4)):
            data[dice.randrange(len(data))] = dice.randrange(256)
        refused += refusal(bytes(data), WIDGETS.get) is not None
    assert refused > 4000
