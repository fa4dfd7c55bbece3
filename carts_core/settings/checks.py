"""Ranges of settings, checked in one way."""

from ..errors import SettingsError


def require(condition: bool, name: str, value: object, allowed: str) -> None:
    """See that a setting is in its range.

    Raises:
        SettingsError: it is not; the message says what was given and what is allowed.
    """
    if not condition:
        raise SettingsError(f"{name} is {value!r}; allowed is {allowed}. Change it, or leave it at its default.")
