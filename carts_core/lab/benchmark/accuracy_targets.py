"""How good the default solver is meant to be, and what the measurements say."""

from statistics import mean

from ...settings import DOMAINS
from ...wording import counted
from .crossing import CROSSING
from .occlusion import OCCLUSION, SHARE
from .scope import REAL, SYNTHETIC
from .statistics import Measurements
from .tables import DOMAIN_LABELS
from .target import Target, make_target

_RECOVERED = 0.95
_CONDITIONS = ("low_brightness", "bleeding", "smoke", "background_change")
"""Of real frames."""
_MODES = {"ours": "each frame alone", "sequence": "in sequence mode"}


def accuracy_targets(data: Measurements) -> list[Target]:
    """The lines of the table that are about masks and joints."""
    return [
        *(_dice_after(data, method, *bound) for method in _MODES for bound in ((1.0, 0.985), (2.0, 0.98), (3.0, 0.97))),
        *(_joint_error(data, method, *bound) for method in _MODES for bound in ((1.0, 0.1), (2.0, 0.25), (3.0, 0.5))),
        _recovery(data),
        _real_dice(data, "real frames, each alone: mean Dice", "ours", 0.962),
        _real_dice(data, "real frames, both cameras in one objective, posed: mean Dice", "stereo_posed", 0.962),
        _real_dice(data, "real frames, one calibration, joints as measured: mean Dice", "calibrated", 0.94),
        _real_robustness(data),
        _made_worse(data),
        _occlusion(data),
        _crossing(data),
        *(target for camera in data.room_cameras() for target in _rooms(data, camera)),
    ]


def _worst_of(means: dict[str, float], worst: str | None) -> str:
    return "no runs" if worst is None else f"domains measured: {len(means)}; worst: {DOMAIN_LABELS[worst]}"


def _dice_after(data: Measurements, method: str, error: float, least: float) -> Target:
    by_domain = {
        domain: [m.final.dice for m in data.of(source=SYNTHETIC, domain=domain, method=method, error_deg=error)]
        for domain in data.domains(SYNTHETIC)
    }
    means = {domain: mean(values) for domain, values in by_domain.items() if values}
    worst = min(means, key=lambda domain: means[domain]) if means else None
    paper = {1.0: "97.9", 2.0: "95.3", 3.0: "90.3"}[error]
    return make_target(
        f"synthetic, {error:g}° off, {_MODES[method]}: mean Dice in every domain",
        least,
        None if worst is None else means[worst],
        _worst_of(means, worst) + (f", mean over {counted(len(by_domain[worst]), 'frame')}" if worst else ""),
        at_least=True,
        text=lambda value: f"{value:.3f}",
        reference=f"paper, S-Reg: {paper}",
        complete=set(means) == set(DOMAINS),
    )


def _joint_error(data: Measurements, method: str, error: float, most: float) -> Target:
    runs = data.of(source=SYNTHETIC, method=method, error_deg=error)
    visible = [m.final.visible_joint_mae_deg for m in runs if m.final.visible_joint_mae_deg is not None]
    everything = [m.final.joint_mae_deg for m in runs if m.final.joint_mae_deg is not None]
    also = f"; all measured joints: {mean(everything):.2f}°" if everything else ""
    paper = {1.0: "0.1°", 2.0: "0.4°", 3.0: "1.3°"}[error]
    return make_target(
        f"synthetic, {error:g}° off, {_MODES[method]}: joint MAE, visible joints",
        most,
        mean(visible) if visible else None,
        (f"mean over {counted(len(visible), 'run')}" if visible else "which joints are visible is not reported") + also,
        at_least=False,
        text=lambda value: f"{value:.2f}°",
        reference=f"paper, S-Reg: {paper}",
    )


def _recovery(data: Measurements) -> Target:
    recovered = [m.final.dice >= _RECOVERED for m in data.of(source=SYNTHETIC, method="ours", error_deg=5.0)]
    return make_target(
        f"synthetic, 5° off: frames recovered to a Dice of {_RECOVERED}",
        0.8,
        mean(recovered) if recovered else None,
        f"{sum(recovered)} of {counted(len(recovered), 'run')}",
        at_least=True,
        text=lambda value: f"{100 * value:.0f} %",
        reference="paper: falls below an initial Dice of 75",
    )


def _real(data: Measurements, domain: str) -> float | None:
    values = [m.final.dice for m in data.of(source=REAL, domain=domain, method="ours", error_deg=None)]
    return mean(values) if values else None


def _real_dice(data: Measurements, what: str, method: str, least: float) -> Target:
    runs = data.of(source=REAL, domain="regular", method=method, error_deg=None)
    start = [m.final.dice for m in data.of(source=REAL, domain="regular", method="start", error_deg=None)]
    without = f"without optimization: {mean(start):.3f} ({counted(len(start), 'frame')}); " if start else ""
    return make_target(
        what,
        least,
        mean(m.final.dice for m in runs) if runs else None,
        f"mean over {counted(len(runs), 'frame')} of the first camera",
        at_least=True,
        text=lambda value: f"{value:.3f}",
        reference=f"{without}mask as target: 0.968",
    )


def _real_robustness(data: Measurements) -> Target:
    clean = _real(data, "regular")
    altered = {domain: value for domain in _CONDITIONS if (value := _real(data, domain)) is not None}
    worst = min(altered, key=lambda domain: altered[domain]) if altered else None
    return make_target(
        "real frames under low light, blood, smoke, other background: Dice lost against clean",
        0.01,
        None if clean is None or worst is None else clean - altered[worst],
        _worst_of(altered, worst),
        at_least=False,
        text=lambda value: f"{round(value, 3) + 0.0:.3f}",
        reference="paper: within 0.026",
        complete=len(altered) == len(_CONDITIONS),
    )


def _made_worse(data: Measurements) -> Target:
    runs = data.default_solver()
    worse = [m for m in runs if m.made_worse]
    covered = sum(m.run.domain == OCCLUSION for m in worse)
    from_truth = sum(m.run.source == SYNTHETIC and m.run.error_deg == 0.0 for m in worse)
    return make_target(
        "frames made worse than their start",
        0.01,
        len(worse) / len(runs) if runs else None,
        f"{len(worse)} of {counted(len(runs), 'run')} lost more than 0.01 Dice; {from_truth} of them started at the "
        f"true joints, {covered} had occluders",
        at_least=False,
        text=lambda value: f"{100 * value:.1f} %",
    )


def _crossing(data: Measurements) -> Target:
    """Of the default solver beside ACS, from the same starts."""
    alone, acs = (data.of(source=SYNTHETIC, domain=CROSSING, method=method) for method in ("ours", "acs"))
    beside = {(m.run.frame, m.run.error_deg): m.final.dice for m in acs}
    behind = [beside[key] - m.final.dice for m in alone if (key := (m.run.frame, m.run.error_deg)) in beside]
    return make_target(
        "synthetic, arms that cross: largest Dice below ACS from the same start",
        0.01,
        max(behind) if behind else None,
        f"{counted(len(behind), 'run')}; mean Dice {mean(m.final.dice for m in alone):.3f}" if behind else "",
        at_least=False,
        text=lambda value: f"{value:.3f}",
    )


def _rooms(data: Measurements, camera: str) -> list[Target]:
    """Of the rooms that are held out."""
    alone, acs = (data.in_rooms(camera, "held-out", method) for method in ("ours", "acs"))
    beside = {(m.run.domain, m.run.frame): m.final.dice for m in acs}
    behind = [
        m.final.dice < beside[m.run.domain, m.run.frame] - 0.01 for m in alone if (m.run.domain, m.run.frame) in beside
    ]
    basis = f"{counted(len(alone), 'run')} in the rooms that are held out"
    percent = lambda value: f"{100 * value:.1f} %"  # noqa: E731
    return [
        make_target(
            f"instruments in other rooms, {camera}: mean Dice",
            0.95,
            mean(m.final.dice for m in alone) if alone else None,
            basis,
            at_least=True,
            text=lambda value: f"{value:.3f}",
            reference=f"ACS, our schedule: {mean(beside.values()):.3f}" if beside else "",
        ),
        make_target(
            f"instruments in other rooms, {camera}: more than 0.01 below ACS from the same start",
            0.0,
            mean(behind) if behind else None,
            f"{sum(behind)} of {basis}",
            at_least=False,
            text=percent,
        ),
        make_target(
            f"instruments in other rooms, {camera}: made worse than their start",
            0.01,
            mean(m.made_worse for m in alone) if alone else None,
            basis,
            at_least=False,
            text=percent,
        ),
    ]


def _occlusion(data: Measurements) -> Target:
    labels = {"ours": "nothing said", "ours_given": "occluder given", "ours_proposed": "mask proposed"}
    means = {
        source: {
            method: mean(m.final.dice for m in runs)
            for method in labels
            if (runs := data.of(source=source, domain=OCCLUSION, method=method, error_deg=None))
        }
        for source in (SYNTHETIC, REAL)
    }
    alone = [found["ours"] for found in means.values() if "ours" in found]
    texts = (
        f"{source}: " + ", ".join(f"{labels[method]} {value:.3f}" for method, value in found.items())
        for source, found in means.items()
        if found
    )
    return make_target(
        f"{100 * SHARE:.0f} % of the visible instrument occluded: mean Dice of the rest",
        0.95,
        min(alone) if alone else None,
        "; ".join(("nothing said of the occluder, the worse of synthetic and real frames", *texts)),
        at_least=True,
        text=lambda value: f"{value:.3f}",
        reference="paper: excludes occlusion",
    )
