"""Result of a fit: mask, joint positions, standard deviations and verdict, with a plot and a display for notebooks."""

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, UInt8

from ..model.camera import Camera
from ..model.scene import Scene, SceneState
from ..notebook import CORRECTED_COLOUR, MEASURED_COLOUR, Picture, display
from ..optimization import Assessment, Iterate, StopReason, Verdict, fit_words, undetermined_joints
from ..rendering import Renderer

if TYPE_CHECKING:
    from matplotlib.axes import Axes

NOT_IN_VIEW = (
    "Check T_camera_base (from base to camera coordinates, in metres), the joint positions (radians and metres) and K."
)
"""Remedy if no arm is in view at the measured joints."""


class JointRow(NamedTuple):
    """Row of the table of a fit; `pandas.DataFrame(fit.rows())` makes a table of all rows."""

    arm: str
    joint: str
    unit: str
    """`rad` or `m`."""
    measured: float
    corrected: float
    std: float
    """Standard deviation; NaN if unknown."""
    determined: bool | None
    """Whether the image determines the joint; None if the standard deviation is unknown."""


@dataclass(frozen=True, eq=False)
class Fit:
    """Fit of robot arms to an image, by `carts_core.fit` or `carts_core.fit_frame`.

    If a fit has failed, it holds the measured joint positions, unless they fit worse, so check `verdict`. Joint
    positions are in the form in which they were given: arrays in the order of the URDF, or dictionaries by joint name;
    for several arms, dictionaries of these by arm.
    """

    image: UInt8[np.ndarray, "height width 3"]
    """RGB image as given to `fit`, not undistorted; for `fit_frame`, the undistorted image."""
    scene: Scene
    """Arms, and the camera of the undistorted image."""
    camera: Camera
    """Camera of `image`, with its distortion. `camera.K` has pixel centres at +0.5, `camera.K_opencv` at integers."""
    start: SceneState
    """Measured state of the scene."""
    measured: dict[str, Float[np.ndarray, " dofs"]]
    """Arm -> measured joint positions [rad, m] in the order of the URDF."""
    result: Iterate
    """Corrected state of the scene, losses and uncertainty."""
    stop_reason: StopReason
    """Termination reason of the optimization."""
    assessment: Assessment | None
    """Verdict with its evidence; None for solvers without a verdict."""
    single: bool = False
    """Whether there is one arm, given without a name."""
    by_name: frozenset[str] = frozenset()
    """Arms with joint positions by joint name."""
    remarks: tuple[str, ...] = ()
    """Warnings on the inputs, as sentences."""

    @cached_property
    def mask(self) -> Bool[np.ndarray, "height width"]:
        """Mask of all arms in `image` at the corrected joint positions."""
        return self._arm_ids(self.result.state) >= 0

    @cached_property
    def measured_mask(self) -> Bool[np.ndarray, "height width"]:
        """Mask of all arms in `image` at the measured joint positions."""
        return self._arm_ids(self.start) >= 0

    @cached_property
    def arm_masks(self) -> dict[str, Bool[np.ndarray, "height width"]]:
        """Arm -> mask of its visible part in `image` at the corrected joint positions."""
        ids = self._arm_ids(self.result.state)
        return {arm.name: ids == index for index, arm in enumerate(self.scene.arms)}

    @property
    def joints(self) -> Any:
        """Corrected joint positions [rad, m]; form as described above."""
        return self._in_given_form(self.result.joint_positions())

    @property
    def std(self) -> Any:
        """Standard deviations of `joints` [rad, m], NaN if unknown; form as described above."""
        return self._in_given_form(self.result.joint_std())

    @property
    def measured_joints(self) -> Any:
        """Measured joint positions [rad, m]; form as described above."""
        return self._in_given_form(self.measured)

    @property
    def T_camera_base(self) -> Any:
        """Transform from an arm's base to the camera [m]; for several arms, a dictionary by arm."""
        state = self.result.state
        Ts = (state.T_view_world[0] @ state.T_world_base).double().cpu().numpy()
        found = {arm.name: T for arm, T in zip(self.scene.arms, Ts, strict=True)}
        return next(iter(found.values())) if self.single else found

    @property
    def verdict(self) -> Verdict | None:
        """`good`, `doubtful` or `failed`; None for solvers without a verdict. It can be compared with these strings."""
        return None if self.assessment is None else self.assessment.verdict

    @property
    def reason(self) -> str:
        """Reason for the verdict, as one sentence."""
        return "" if self.assessment is None else self.assessment.reason

    @property
    def remedy(self) -> str:
        """Remedy as one sentence; empty if none is needed."""
        if self.assessment is None:
            return ""
        return self.assessment.remedy if self.measured_mask.any() else NOT_IN_VIEW

    @property
    def undetermined(self) -> list[str]:
        """`ARM.JOINT` of each joint that the image does not determine."""
        return undetermined_joints(self.scene, self.result.joint_std()) or []

    def rows(self) -> list[JointRow]:
        """Table of all joints: measured and corrected position, and standard deviation."""
        measured, corrected, std = self.measured, self.result.joint_positions(), self.result.joint_std()
        undetermined = undetermined_joints(self.scene, std)
        return [
            JointRow(
                arm.name,
                joint,
                "rad" if kind == "revolute" else "m",
                float(measured[arm.name][index]),
                float(corrected[arm.name][index]),
                float(std[arm.name][index]),
                None
                if undetermined is None or np.isnan(std[arm.name][index])
                else f"{arm.name}.{joint}" not in undetermined,
            )
            for arm in self.scene.arms
            for index, (joint, kind) in enumerate(zip(arm.robot.joint_names, arm.robot.joint_types, strict=True))
        ]

    def overlay(self) -> UInt8[np.ndarray, "height width 3"]:
        """The image with the outlines of the measured arms (orange) and of the corrected arms (green), RGB."""
        return self._picture().drawn()

    def plot(self, ax: "Axes | None" = None) -> "Axes":
        """Draw the image with the outlines of the measured arms (orange) and of the corrected arms (green).

        Coordinates are pixels in OpenCV's convention, as in `Axes.imshow`: pixel centres are at integers.

        Args:
            ax: axes to draw on; by default those of a new figure.

        Returns:
            The axes; their attribute `figure` is the figure to show or to write to a file.
        """
        if ax is None:
            import matplotlib.pyplot as plt  # noqa: PLC0415 - takes half a second

            _, ax = plt.subplots(figsize=(8, 8 * self.image.shape[0] / self.image.shape[1]), layout="constrained")
        ax.imshow(self.image)
        for label, mask, colour, style in (
            ("measured", self.measured_mask, MEASURED_COLOUR, "dashed"),
            ("corrected", self.mask, CORRECTED_COLOUR, "solid"),
        ):
            rgb = tuple(value / 255 for value in colour)
            if mask.any() and not mask.all():
                ax.contour(mask, levels=[0.5], colors=[rgb], linewidths=1.2, linestyles=style)
            ax.plot([], [], color=rgb, linestyle=style, label=label)
        ax.legend(loc="upper right", fontsize="small")
        ax.set_title(self.summary, fontsize="medium")
        ax.set_axis_off()
        return ax

    @property
    def summary(self) -> str:
        """Verdict and number of undetermined joints as text: `mask good, 4 joints not determined`."""
        known = undetermined_joints(self.scene, self.result.joint_std())
        return fit_words("not assessed" if self.verdict is None else self.verdict.value, known)

    def __repr__(self) -> str:
        arms = ", ".join(f"{arm.name} ({len(arm.robot.joint_names)} joints)" for arm in self.scene.arms)
        return f"Fit({self.summary}; {arms}; {self.image.shape[1]} x {self.image.shape[0]} px)"

    def _repr_html_(self) -> str:
        table = [
            {
                **({} if self.single else {"arm": row.arm}),
                "joint": row.joint,
                "unit": row.unit,
                "measured": f"{row.measured:.4f}",
                "corrected": f"{row.corrected:.4f}",
                "change": f"{row.corrected - row.measured:+.4f}",
                "std": "" if np.isnan(row.std) else f"{row.std:.4f}",
                "determined": {None: "", True: "yes", False: "no"}[row.determined],
            }
            for row in self.rows()
        ]
        reasons = " ".join(filter(None, (self.reason, self.remedy)))
        legend = "Outlines: measured (orange), corrected (green)."
        return display(self.summary, self._picture(), (reasons, *self.remarks, legend), table)

    def _picture(self) -> Picture:
        outlines = ((self.measured_mask, MEASURED_COLOUR), (self.mask, CORRECTED_COLOUR))
        return Picture(self.image, outlines)

    def _arm_ids(self, state: SceneState) -> np.ndarray:
        """Arm index per pixel of `image`, or -1."""
        ids = Renderer(self.scene, window=self.camera.recorded_window).segment(state.to("cpu"))[0]
        if not any(self.camera.distortion):
            return ids
        recorded = np.full((self.camera.height, self.camera.width), -1, ids.dtype)
        for index in range(len(self.scene.arms)):
            recorded[self.camera.distorted_mask(ids == index)] = index
        return recorded

    def _in_given_form(self, values: dict[str, Float[np.ndarray, " dofs"]]) -> Any:
        found: dict[str, Any] = {
            arm.name: dict(zip(arm.robot.joint_names, values[arm.name].tolist(), strict=True))
            if arm.name in self.by_name
            else values[arm.name]
            for arm in self.scene.arms
        }
        return next(iter(found.values())) if self.single else found
