"""YAML of other programs, with a bounded depth."""

from typing import Any

from ...extras import needs_extra
from ...files.reading import LARGEST_DEPTH


def parse_yaml(text: str) -> Any:
    """YAML as dictionaries, lists, numbers and texts.

    Raises:
        ValueError: it is not YAML, or is nested more deeply than any calibration or table.
        CartsError: the package that reads it is not installed.
    """
    needs_extra("yaml", "import")
    import yaml  # noqa: PLC0415

    loader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    try:
        # Building the values goes as deep as they are nested, which ends the process where that is without end.
        depth = 0
        for event in yaml.parse(text, Loader=loader):
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            if depth > LARGEST_DEPTH:
                raise ValueError(f"it is nested more than {LARGEST_DEPTH} levels deep")
        return yaml.load(text, Loader=loader)
    except yaml.YAMLError as error:
        raise ValueError(" ".join(str(error).split())) from error
