"""The command `det2stoc serve`."""

from pathlib import Path
from typing import Annotated

import typer

from det2stoc_bayes.cli import Debug, app
from det2stoc_bayes.cli_help import EXAMPLES
from det2stoc_bayes.streams import reporting, show


@app.command(epilog=EXAMPLES["serve"])
def serve(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="A folder of results.", show_default=False)],
    host: Annotated[str, typer.Option(metavar="ADDRESS", help="127.0.0.1: for this machine alone.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="0: any that is free.")] = 8765,
    open_it: Annotated[bool, typer.Option("--open", help="Open it in the browser.")] = False,
    debug: Debug = False,
) -> None:
    """Show a folder of results as a local page: list, filter, compare two; Ctrl-C ends it."""
    with reporting(debug):
        import warnings
        import webbrowser

        from det2stoc_bayes.recording import StudyWarning
        from det2stoc_bayes.server import Results

        server = Results(folder, host, port)
        if not server.is_local:
            told = f"--host {host}: whoever reaches this address can read all results in {folder}"
            warnings.warn(told, StudyWarning, stacklevel=1)
        show(f"Results in {folder}: {server.url} (Ctrl-C ends)", as_json=False)
        if open_it:
            webbrowser.open(server.url)
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            show("ended", as_json=False)
        finally:
            server.server_close()
