"""``ctxval serve``: the operator's page."""

from __future__ import annotations

import functools
import importlib
from pathlib import Path
from typing import Annotated, Any

import typer

from ctxval.cli.base import command, out
from ctxval.cli.commands import app
from ctxval.cli.options import StoreArgument, Threshold
from ctxval.cli.trust import AcceptChange, Named, Opened, Trust, budget_of, limit_of, open_store, settings_of
from ctxval.config.settings import Settings
from ctxval.errors import InputError
from ctxval.storage.store import Store
from ctxval.web.served import ServedCampaign

Host = Annotated[
    str,
    typer.Option(
        help="Address to listen at. Only browsers on this computer reach the default. Every other address needs a "
        "token, for example 0.0.0.0, which all computers of the network reach."
    ),
]
Port = Annotated[int, typer.Option(help="Port to listen at; 0 chooses a free port.")]
Token = Annotated[
    str | None,
    typer.Option(
        envvar="CTXVAL_TOKEN",
        help="Token that a browser must show once, of at least 16 characters (default: a random token that is printed, "
        "and no token at the default address). Other users of this computer can read the command line: set the "
        "environment variable instead.",
    ),
]
Budget = Annotated[
    int | None,
    typer.Option(
        help="Maximum number of executions that are chosen for the verdict, including earlier ones in the store "
        "(default: the budget of the campaign)."
    ),
]
AllowHost = Annotated[
    list[str] | None,
    typer.Option(
        metavar="NAME",
        help="Further name under which browsers may address the server, for example that of a proxy. Repeat "
        "--allow-host to set several.",
    ),
]


@app.command()
@command
def serve(
    store: StoreArgument,
    host: Host = "127.0.0.1",
    port: Port = 8765,
    token: Token = None,
    allow_host: AllowHost = None,
    threshold: Threshold = None,
    budget: Budget = None,
    experiment: Named = None,
    trust: Trust = False,
    accept_change: AcceptChange = None,
) -> Any:
    """Serve a page for the people who execute the tasks of a store by hand.

    The page shows the next task and its files. It takes recordings and failures, and shows the verdict. Ctrl-C stops
    the server.
    """
    web = web_server()
    address = web.Address(host, port, token, tuple(allow_host or ()))
    settings = settings_of(Store.existing(store), experiment, trust)
    again = functools.partial(_reopened, settings, store, threshold, budget)

    def first() -> ServedCampaign:
        return _served(open_store(Store.existing(store), store, experiment, trust, accept_change), threshold, budget)

    def say_started(place: str, secret: str | None) -> None:
        out.say(f"the page is at {place}" + ("" if secret is None else f"?token={secret}"))
        if secret is not None:
            out.say("everybody who has this address can record results. It is sent without encryption.")
        out.say("Ctrl-C stops the server; all results are stored.")

    web.serve(first, again, address, say_started)


def _reopened(settings: Settings, path: Path, threshold: float | None, budget: int | None) -> ServedCampaign:
    """Open a store by settings that the user has allowed to run here: those in it may have been changed since."""
    made = settings.load()
    campaign = settings.campaign(made, Store.existing(path))
    return _served(Opened(settings, made, campaign, path), threshold, budget)


def _served(opened: Opened, threshold: float | None, budget: int | None) -> ServedCampaign:
    limit = limit_of(opened.experiment, opened.settings, threshold)
    total = budget_of(opened.experiment, opened.settings, budget)
    return ServedCampaign(opened.experiment, opened.campaign, limit, opened.settings.certificate_options, total)


def web_server() -> Any:
    """Return the module of the server, which needs the extra ``web``."""
    try:
        return importlib.import_module("ctxval.web.server")
    except ImportError as error:
        raise InputError(f"the page needs {error.name}: pip install 'ctxval[web]'.") from error
