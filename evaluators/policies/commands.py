"""``cudc-bench export``, ``cudc-bench render`` and ``cudc-bench ask``."""

from __future__ import annotations

from typing import Annotated

import typer

from cudc_bench.cli import completion
from cudc_bench.cli.options import RewardOption

RecordArgument = Annotated[str, typer.Argument(metavar="RECORD", help="Run record, as evaluate named it; its policy lies beside it.")]


def export(
    record: RecordArgument,
    output: Annotated[str | None, typer.Option("--output", help="File to write, *.pt2; beside the record by default.")] = None,
) -> None:
    """Write a trained policy as one file that needs PyTorch alone."""
    import shlex

    from cudc_bench.execution.progress import echo

    from .exporting import SPEC, export_policy

    path = export_policy(record, output)
    print(path)
    echo(f"load it with: torch.export.load({str(path)!r}).module()")
    echo(f"what it takes and where it comes from: unzip -p {shlex.quote(str(path))} '*/{SPEC}'")


def render(
    record: RecordArgument,
    episodes: Annotated[int, typer.Option("--episodes", help="Episodes, one after the other.")] = 1,
    seed: Annotated[
        int | None, typer.Option("--seed", help="Of the first episode; those of the record's final evaluation by default.")
    ] = None,
    output: Annotated[str | None, typer.Option("--output", help="File to write, *.mp4 or *.gif; beside the record by default.")] = None,
    width: Annotated[int | None, typer.Option("--width", help="Pixels; 640 in an MP4, 320 in a GIF.")] = None,
    height: Annotated[int | None, typer.Option("--height", help="Pixels; 480 in an MP4, 240 in a GIF.")] = None,
    fps: Annotated[float, typer.Option("--fps", help="Frames a second.")] = 25.0,
    camera: Annotated[str | None, typer.Option("--camera", help="Name or number of one of the model's cameras.")] = None,
    reward: Annotated[
        str | None, typer.Option("--reward", help="Own reward function that the policy was trained on, to measure its return.")
    ] = None,
) -> None:
    """Play a trained policy and write a video of it; the return is the recorded one."""
    import os

    # The process that draws gets the user's choice. This one draws nothing, and need not fail where the choice does not work.
    gl, os.environ["MUJOCO_GL"] = os.environ.get("MUJOCO_GL"), "disabled"

    from .rendering import render_policy

    done = render_policy(
        record, output, episodes=episodes, seed=seed, width=width, height=height, fps=fps, camera=camera, reward=reward, gl=gl or ""
    )
    print(done.path)


def ask(
    policy: Annotated[str, typer.Argument(metavar="POLICY", help="A record of a learner without rewards, or its *.learner.pt.")],
    reward: RewardOption = None,
    task: Annotated[str | None, typer.Option("--task", help="A task of the domain, instead of --reward.")] = None,
    goal: Annotated[
        str | None, typer.Option("--goal", help="A state to reach instead: a file *.npy of one, or EPISODE:STEP of the dataset.")
    ] = None,
    labels: Annotated[int | None, typer.Option("--labels", help="Transitions whose rewards it is told, 10000 by default.")] = None,
    labels_from: Annotated[
        str | None,
        typer.Option("--labels-from", help="Draw these from another dataset than the one trained on.", autocompletion=completion.datasets),
    ] = None,
    episodes: Annotated[int, typer.Option("--episodes", help="How many it is tried in.")] = 10,
    render: Annotated[bool, typer.Option("--render", help="Also write a video of it.")] = False,
    output: Annotated[str, typer.Option("--output", help="Folder of the answer's record, policy and video.")] = "asked",
) -> None:
    """Ask a trained learner without rewards for a policy that pursues a reward, and try it; nothing is trained."""
    import os
    from statistics import fmean, pstdev

    gl, os.environ["MUJOCO_GL"] = os.environ.get("MUJOCO_GL"), "disabled"

    from cudc_bench.artefacts.records import LABELS, read_record
    from cudc_bench.execution.progress import echo

    from .asking import ask_policy

    asked = ask_policy(
        policy, reward, task=task, goal=goal, labels=LABELS if labels is None else labels, labels_from=labels_from, episodes=episodes,
        output=output,
    )  # fmt: skip
    print(asked.record)
    function = read_record(asked.record).dataset.reward
    labelled = "minus the distance from the goal, summed" if goal else f"{asked.rewarded:.1%} of the labels have a reward"
    echo(
        f"{fmean(asked.returns):.1f} ± {pstdev(asked.returns):.1f} over {len(asked.returns)} episodes; {labelled};"
        f" asked and tried in {asked.seconds:.1f} s"
    )
    if render:
        from .rendering import render_policy

        print(render_policy(asked.record, reward=None if function is None else function.reference, gl=gl or "").path)
    else:
        echo(f"next: cudc-bench render {asked.record}")
