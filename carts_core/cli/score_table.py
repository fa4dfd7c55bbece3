"""The table that `carts evaluate` prints."""

from rich.table import Table

from ..evaluation import FrameScore, mean_score


def score_table(scores: list[FrameScore], title: str) -> Table:
    """Means per domain and camera."""
    table = Table(title=title, caption="MAE, std: of measured revolute joints. s: wall time per frame.")
    for column in (
        "domain",
        "camera",
        "Dice\nbefore",
        "\nafter",
        "worst\nchange",
        "MAE [deg]\nbefore",
        "\nafter",
        "std",
        "steps",
        "s",
    ):
        table.add_column(column, justify="left" if column in ("domain", "camera") else "right")
    groups: dict[tuple[str, str], list[FrameScore]] = {}
    for score in scores:
        groups.setdefault((score.domain, score.camera), []).append(score)
    for (domain, camera), group in groups.items():
        mean = mean_score(group)
        change = [s.dice_after - s.dice_before for s in group if s.dice_after is not None and s.dice_before is not None]
        table.add_row(
            domain,
            camera,
            _number(mean["dice_before"], 4),
            _number(mean["dice_after"], 4),
            _number(min(change, default=None), 4),
            _number(mean["joint_mae_deg_before"], 2),
            _number(mean["joint_mae_deg_after"], 2),
            _number(mean["joint_std_deg"], 2),
            _number(mean["iterations"], 1),
            _number(mean["seconds"], 2),
        )
    return table


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
