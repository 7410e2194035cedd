"""`deepracer-exp export`: a trained policy, its training files or its logs for other programs."""

import argparse
from pathlib import Path

from .arguments import add_run, run_and_overrides
from .output import warnings_on_stderr
from .startup import check_run

_EPILOG = """\
  deepracer-exp export RUN format=onnx                      the network as one file, checked against itself
  deepracer-exp export RUN format=onnx checkpoint=last -o policy.onnx
  deepracer-exp export champion format=onnx                 the checkpoint with that alias (deepracer-exp runs promote)
  deepracer-exp export RUN format=aws -o custom_files       reward_function.py, model_metadata.json and
                                                            hyperparameters.json
  deepracer-exp export RUN format=aws-logs                  trace, metrics and logs of the training, as in an archive
                                                            of the AWS console (deepracer-utils reads it)
  deepracer-exp export RUN format=aws-logs layout=deepracer-for-cloud
"""


def add_export(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command."""
    parser = commands.add_parser(
        "export",
        help="write a trained policy, its training files or its logs for other programs",
        description="Write a run's policy as ONNX, the files that AWS's console and deepracer-for-cloud train from, or "
        "its logs in the format of these two.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add_run(parser, "format=onnx|aws|aws-logs | KEY=VALUE")
    parser.add_argument(
        "-o", "--output", help="file or folder to write (default: in the run's folder, export/)"
    )
    parser.set_defaults(command=_export, entry="export")


def _export(args: argparse.Namespace) -> int:
    from deepracer_exp.config.compose import compose_export
    from deepracer_exp.config.overrides import override_line
    from deepracer_exp.runs.resolve import resolve

    run, overrides = run_and_overrides(args)
    config, _ = compose_export([*overrides, override_line("run", run)])
    args.debug = config.debug
    if config.format == "onnx":
        check_run(config.run, config.runs_dir, config.tracking.uri, config.checkpoint)
    else:
        resolve(config.run, Path(config.runs_dir), config.tracking.uri)

    from rich.console import Console

    from deepracer_exp.export.export import export

    with warnings_on_stderr():
        export(config, args.output, Console(highlight=False, markup=False))
    return 0
