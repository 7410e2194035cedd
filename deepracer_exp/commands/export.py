"""`deepracer-exp export`: a trained policy, or what it was trained with, for other programs."""

import argparse
from pathlib import Path

from .stderr_warnings import warnings_on_stderr

_EPILOG = """\
  deepracer-exp export run=RUN format=onnx                  the network as one file, checked against itself
  deepracer-exp export run=RUN format=onnx checkpoint=last -o policy.onnx
  deepracer-exp export run=champion format=onnx             the checkpoint of that alias (deepracer-exp promote)
  deepracer-exp export run=RUN format=aws -o custom_files   reward_function.py, model_metadata.json and
                                                            hyperparameters.json
  deepracer-exp export run=RUN format=aws-logs              trace, metrics and logs of its training, as in an archive
                                                            of the AWS console (deepracer-utils reads it)
  deepracer-exp export run=RUN format=aws-logs layout=deepracer-for-cloud
"""


def register(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command."""
    export = commands.add_parser(
        "export",
        help="write a trained policy, or what it was trained with, for other programs",
        description="Write a run's policy as ONNX, the files that AWS's console and deepracer-for-cloud train from, or "
        "its logs as these two write them.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    export.add_argument("overrides", nargs="*", metavar="run=RUN | format=onnx|aws|aws-logs | KEY=VALUE")
    export.add_argument(
        "-o", "--output", help="file or folder to write (default: in the run's folder, export/)"
    )
    export.set_defaults(command=_export)


def _export(args: argparse.Namespace) -> int:
    from deepracer_exp.config.compose import compose_export
    from deepracer_exp.evaluation.references import resolve

    from .checking import check_run

    config, _ = compose_export(args.overrides)
    args.debug = config.debug
    if config.format == "onnx":
        check_run(config.run, config.runs_dir, config.tracking_uri, config.checkpoint)
    else:
        resolve(config.run, Path(config.runs_dir), config.tracking_uri)

    from rich.console import Console

    from deepracer_exp.export.export import export

    with warnings_on_stderr():
        export(config, args.output, Console(highlight=False, markup=False))
    return 0
