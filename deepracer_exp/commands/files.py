"""`deepracer-exp import` and `export`: files of other programs."""

import argparse
from pathlib import Path

from .arguments import add_command, add_run, run_and_overrides
from .output import print_notes, warnings_on_stderr
from .startup import check_policy


def add_commands(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the commands."""
    parser = add_command(
        commands,
        "import",
        _import,
        help="turn a DeepRacer model's files into options",
        description=(
            "Turn reward_function.py, model_metadata.json and hyperparameters.json, whichever of them are there, into "
            "options: files in ./conf, to train with and to edit. Every command offers the options in ./conf of the "
            "current folder beside the project's own. To train with such files once: deepracer-exp train "
            "custom_files=DIR."
        ),
    )
    parser.add_argument(
        "folder", metavar="DIR", help="deepracer-for-cloud's custom_files, or a model's folder"
    )
    parser.add_argument(
        "--name", required=True, help="name of the options, as in: deepracer-exp train experiment=NAME"
    )

    parser = add_command(
        commands,
        "export",
        _export,
        help="write a trained policy, its training files or its logs for other programs",
        description="Write a run's policy as ONNX, the files that AWS's console and deepracer-for-cloud train from, or "
        "its logs in the format of these two.",
        epilog=_EXPORT_EPILOG,
        entry="export",
    )
    add_run(parser, "format=onnx|aws|aws-logs | KEY=VALUE")
    parser.add_argument(
        "-o", "--output", help="file or folder to write (default: in the run's folder, export/)"
    )


def _import(args: argparse.Namespace) -> int:
    from deepracer_exp.config.compose import compose_experiment
    from deepracer_exp.config.custom_files import KEY, import_files, read_custom_files
    from deepracer_exp.config.overrides import override_line
    from deepracer_exp.rewards.source import load_reward_source

    files = read_custom_files(args.folder)
    experiment, composition = compose_experiment([override_line(KEY, args.folder)])
    load_reward_source(experiment.reward)
    written = import_files(files, args.name, composition.mapping)
    print_notes(composition.notes)
    for path in written:
        print(path)
    print(f"\n  train it  deepracer-exp train experiment={args.name}")
    return 0


_EXPORT_EPILOG = """\
  deepracer-exp export RUN format=onnx                      the network as one file, checked against itself
  deepracer-exp export RUN format=onnx checkpoint=last -o policy.onnx
  deepracer-exp export champion format=onnx                 the checkpoint with that alias (deepracer-exp runs promote)
  deepracer-exp export RUN format=aws -o custom_files       reward_function.py, model_metadata.json and
                                                            hyperparameters.json
  deepracer-exp export RUN format=aws-logs                  trace, metrics and logs of the training, as in an archive
                                                            of the AWS console (deepracer-utils reads it)
  deepracer-exp export RUN format=aws-logs layout=deepracer-for-cloud
"""


def _export(args: argparse.Namespace) -> int:
    from deepracer_exp.config.compose import compose_export
    from deepracer_exp.config.overrides import override_line
    from deepracer_exp.runs.resolve import resolve

    run, overrides = run_and_overrides(args)
    config, _ = compose_export([*overrides, override_line("run", run)])
    args.debug = config.debug
    if config.format == "onnx":
        check_policy(config.run, config.runs_dir, config.tracking.uri, config.checkpoint)
    else:
        resolve(config.run, Path(config.runs_dir), config.tracking.uri)

    from rich.console import Console

    from deepracer_exp.export.export import export

    with warnings_on_stderr():
        export(config, args.output, Console(highlight=False, markup=False))
    return 0
