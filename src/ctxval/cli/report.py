"""``ctxval report``: write the report of a store, for people and for programs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

from ctxval import report as reports
from ctxval._util.checked import PositiveFloat, require
from ctxval._util.files import write_text
from ctxval.certificates import KINDS, CertificateOptions
from ctxval.cli.base import FALSIFIED, command, out
from ctxval.cli.certify import KindOptions, Volume
from ctxval.cli.commands import app
from ctxval.cli.options import AsJson, Confidence, StoreArgument, Threshold, named_values
from ctxval.cli.outputs import Force, require_outputs
from ctxval.cli.trust import Named, Trust, budget_of, limit_of, open_store
from ctxval.config.settings import Settings
from ctxval.config.stored_settings import planned_settings
from ctxval.core.labels import Labels, labels_of
from ctxval.errors import CtxvalError
from ctxval.report.context import context_of_campaign, context_of_store
from ctxval.storage.store import Store

Page = Annotated[
    Path | None,
    typer.Option(
        "-o", "--out", help="HTML file to write (default: a file next to the store that ends in .report.html)."
    ),
]
JUnit = Annotated[
    Path | None,
    typer.Option("--junit", metavar="FILE.xml", help="Also write the verdict and the diagnostics as JUnit XML."),
]
Markdown = Annotated[
    Path | None, typer.Option("--markdown", metavar="FILE.md", help="Also write the report without charts as Markdown.")
]

Kind = Annotated[
    str | None,
    typer.Option(
        help=f"Kind of the certificate: {', '.join(KINDS.built_in)}, or a kind from an installed package (default: the "
        "kind that the campaign was run with). With region, the report has a map of where the threshold is kept."
    ),
]


@app.command("report")
@command
def write_report(
    store: StoreArgument,
    page: Page = None,
    threshold: Threshold = None,
    confidence: Confidence = None,
    kind: Kind = None,
    volume: Volume = None,
    option: KindOptions = None,
    junit: JUnit = None,
    markdown: Markdown = None,
    force: Force = False,
    experiment: Named = None,
    trust: Trust = False,
    as_json: AsJson = False,
) -> Any:
    """Write the report of a store: one HTML page with the verdict, insights, charts and trials.

    The system is not executed. The experiment is loaded if its store names no code, or if you made the store or allow
    its code. Otherwise the report says what is missing without it.

    Options that are not given have the values that the campaign was run with.
    """
    opened = Store.existing(store)
    target = page_path(store) if page is None else page
    require_outputs(
        {"--out .html": target, "--junit .xml": junit, "--markdown .md": markdown}, [store, experiment], force=force
    )
    require("threshold", PositiveFloat | None, threshold)
    stated = named_values(option, volume=volume)

    def certificate(settings: Settings) -> CertificateOptions:
        planned = settings.confidence if confidence is None else confidence
        return settings.certificate.options(planned, kind=kind, stated=stated)

    try:
        loaded = open_store(opened, store, experiment, trust)
    except CtxvalError as error:
        if experiment is not None or trust:
            raise
        # The experiment may not be loaded, and no code is imported or run.
        settings = planned_settings(opened, kind)
        labels = Labels(labels_of(settings.states), labels_of(settings.inputs), settings.units or "")
        limit = settings.threshold if threshold is None else threshold
        context = context_of_store(opened, limit, certificate=certificate(settings), missing=str(error), labels=labels)
        context = replace(context, budget=settings.budget)
    else:
        settings, made = loaded.settings, loaded.experiment
        context = context_of_campaign(
            loaded.campaign,
            threshold=limit_of(made, settings, threshold),
            certificate=certificate(settings),
            budget=budget_of(made, settings),
        )
    written = {"report": str(reports.write_page(context, target))}
    if junit is not None:
        written["junit"] = str(write_text(junit, reports.junit(context)))
    if markdown is not None:
        written["markdown"] = str(write_text(markdown, reports.markdown(context)))
    verdict = context.verdict
    if not as_json:
        out.say(", ".join(written.values()))
        if context.missing:
            out.say(f"without the experiment: {context.missing}", wrap=True)
    result = {**reports.to_json(context), "files": written} if as_json else {}
    return result, FALSIFIED if verdict is not None and verdict.answer == "falsified" else 0


def page_path(store: Path) -> Path:
    """Return the path of the report of a store."""
    return store.with_suffix(".report.html")
