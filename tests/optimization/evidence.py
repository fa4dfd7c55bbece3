"""Evidence of a correct fit."""

from carts_core.optimization import Evidence

CONVINCING = Evidence(
    area=0.05,
    start_area=0.05,
    loss=0.01,
    residual=0.05,
    agreement=0.95,
    unconditioned=0.93,
    predicted=0.95,
    changed=0.97,
    overlap_with_change=0.85,
)
