"""Words of messages and reports."""


def counted(number: int, what: str) -> str:
    """A number of things, such as `1 run` and `2 runs`."""
    return f"{number} {what}{'' if number == 1 else 's'}"
