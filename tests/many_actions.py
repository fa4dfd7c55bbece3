"""Long runs of state machines."""

from hypothesis import settings
from hypothesis.stateful import RuleBasedStateMachine, invariant, run_state_machine_as_test


def check_after_each_of_10000_actions(machine: type[RuleBasedStateMachine]) -> None:
    """Run a machine until its invariants were checked after a minimum number of actions."""
    checks = 0

    class CountingMachine(machine):
        @invariant()
        def count(self) -> None:
            nonlocal checks
            checks += 1

    # A run may stop before its last action, so there are some more runs than 100.
    runs = 130
    run_state_machine_as_test(
        CountingMachine, settings=settings(max_examples=runs, stateful_step_count=100, deadline=None, database=None)
    )
    assert checks - 2 * runs >= 10_000, "a run is checked before it begins, too, and after its beginning"
