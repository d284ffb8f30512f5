"""Notes under the tables."""

from collections.abc import Sequence

from starjax.report import formats, results
from starjax.sim.task import TaskText

CELL = "Successes/trials and the 95% Wilson interval in brackets."
SUCCESS = (
    f"{CELL[:-1]}; the gap is seen minus unseen in percentage points with Newcombe's 95% "
    "interval, and means little where both are low."
)
PAIRED = (
    "McNemar's exact test on trials with the same trocar and seed; Holm corrects for the number "
    "of comparisons."
)
SWEPT = (
    "Trials of the sweep, all of them and by the distance of their trocar to the nearest one in "
    "the demonstrations."
)
FAILURES = "Each failed trial is counted under the first class that applies."
RCM = (
    "Distance of the shaft's axis from the trocar. Commanded: of the policy's command. "
    "Executed: of the simulated arm, at the ends of all control steps of all trials or of "
    "the successful ones; a trial that fails has up to ten times as many steps. Within steps: the "
    "largest at any physics step of each control step, where the servos have not answered yet."
)
PHASES = (
    "Wall-clock time, summed over every start. Methods share the demonstrations, and some weights "
    "and trials."
)
INFERENCE = (
    "One decision for one environment: observation in, commands out; compiling is not counted. "
    "One DDIM step is a time only: its plan is the noise that it began with."
)


def tests(text: TaskText) -> dict[str, str]:
    """Returns the definitions of the success tests for a task."""
    return {
        "strict": text.strict,
        "loose": text.loose,
        "safe": "strict, and the executed RCM error never passed 2 mm",
    }


def by_test(text: TaskText) -> str:
    """Joins the definitions in one line."""
    return (
        ". ".join(f"{name.capitalize()}: {meaning}" for name, meaning in tests(text).items()) + "."
    )


def inference(runs: Sequence[results.Run]) -> str:
    """Returns the note of Table IV, with the machine of `starjax bench` if it is another one."""
    note = INFERENCE
    for run in runs:
        timed, scored = (
            formats.hardware(x.get("hardware") or {}) for x in (run.bench, run.result.about)
        )
        if timed and timed != scored:
            rows = ", ".join(sorted(run.bench["inference_ms_by_ddim_steps"], key=int))
            note += f" {run.label}'s rows of {rows} steps are of {timed}."
    return note
