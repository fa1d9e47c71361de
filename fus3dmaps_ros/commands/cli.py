"""The ``fus3dmaps`` command. Each sub-command imports what it needs when it runs, so that help appears at once."""

from __future__ import annotations

import sys

import typer

from fus3dmaps_core.errors import Fus3dmapsError
from fus3dmaps_ros.commands.encoders import encoders
from fus3dmaps_ros.commands.evaluate import evaluate
from fus3dmaps_ros.commands.export import export
from fus3dmaps_ros.commands.live import ask, demo, node, play
from fus3dmaps_ros.commands.maps import map_, query
from fus3dmaps_ros.commands.recordings import convert, simulate
from fus3dmaps_ros.commands.terminal import LOG

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    help="Open-vocabulary 3D maps from posed RGB-D images.",
)
# In the order in which the help lists them.
app.command()(convert)
app.command(name="map")(map_)
app.command()(query)
app.command(context_settings={"allow_extra_args": True, "ignore_unknown_options": True})(node)
for command in (play, ask, simulate, evaluate, encoders, export, demo):
    app.command()(command)


def main() -> None:
    """Run the command; a refusal is one line on stderr and exit code 1."""
    try:
        app()
    except Fus3dmapsError as error:
        LOG.print(f"fus3dmaps: {error}", markup=False, style="red", soft_wrap=True)
        sys.exit(1)
    except KeyboardInterrupt:
        sys.exit(130)


if __name__ == "__main__":
    main()
