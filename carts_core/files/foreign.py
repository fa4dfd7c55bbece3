"""Foreign texts in tables: spreadsheets must not run them."""

_FORMULA = ("=", "+", "-", "@", "\t", "\r")
"""What makes a spreadsheet take a cell for a formula."""


def csv_cell(text: str) -> str:
    """A text as a cell that no spreadsheet takes for a formula: an apostrophe goes before what could be one.

    Numbers stay as they are. `text_of_cell` gives the text back.
    """
    risky = text.startswith(_FORMULA) and not _is_number(text)
    return f"'{text}" if risky or text.startswith("'") else text


def text_of_cell(cell: str) -> str:
    """What `csv_cell` was given."""
    return cell.removeprefix("'")


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return text.isascii() and text[-1:].isalnum()
