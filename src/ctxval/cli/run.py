"""``ctxval run``: execute the tasks that decide, and give the verdict."""

from __future__ import annotations

import os
import shlex
import sys
import webbrowser
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from ctxval import Campaign, Experiment, Verdict
from ctxval._util.progress import also_listening
from ctxval._util.refusals import require_extra, reworded
from ctxval._util.texts import reason_of
from ctxval.campaign.storage.other_stores import other_stores
from ctxval.campaign.suite_intervals import interval_search
from ctxval.certificates import Certificate
from ctxval.certificates.envelope import Envelope
from ctxval.cli import base
from ctxval.cli.base import NewStore, Parallel, command, err, named_values, notes, out, print_table
from ctxval.cli.config.settings import ExperimentSettings, read_settings
from ctxval.cli.config.stored_settings import Limits
from ctxval.core.trajectory import Transitions
from ctxval.core.trial import designs_sentence
from ctxval.errors import CertificateError, InputError

if TYPE_CHECKING:
    from ctxval.web.state import LiveCampaign


@command()
def run(
    target: str,
    made: NewStore,
    limits: Limits,
    parallel: Parallel,
    confidence: float | None = None,
    explore: bool | None = None,
    envelope: bool = False,
    within: float | None = None,
    thinking: float | None = None,
    tests: int | None = None,
    quantile: float | None = None,
    share: float | None = None,
    resolution: float | None = None,
    dask: str | None = None,
    again_failed: str | None = None,
    accept_change: str | None = None,
    with_report: bool = True,
    live: bool = False,
    option: list[str] | None = None,
) -> Any:
    stated = {
        "confidence": confidence,
        "explore": explore,
        "within": within,
        "thinking": thinking,
        "options": named_values(option),
    }
    settings = read_settings(target, {**vars(made), **vars(limits), **stated})
    settings = settings.certified_as({"resolution": resolution, "tests": tests, "quantile": quantile, "share": share})
    experiment, certificate = settings.load(), settings.certificate_options
    if (doubt := experiment.doubt_of_parameters) is not None:
        notes.say(doubt)
    limit, total = limits.completed_by(settings, experiment)
    if envelope and limit is None:
        raise InputError("--envelope needs --threshold: it is the largest acceptable distance.")
    path = settings.store_path(experiment.name)
    campaign = settings.campaign(experiment, path, accept_change=accept_change)
    if limit is not None:
        certificate.kind.require_usable(certificate.confidence, total)  # before executions are paid for
    _print_parts(experiment, limit)
    with _live_page((experiment, campaign, limit, certificate, total), settings) if live else nullcontext() as shown:
        with _pool(parallel, dask) as pool:
            campaign.run(
                total,
                limit,
                None if shown is None else shown.take,
                explore=settings.explores,
                envelope=envelope,
                within=settings.within,
                certificate=certificate,
                thinking=settings.thinking,
                again=again_failed,
                **pool,
            )
        digest = campaign.store.digest()
        verdict = (
            None if limit is None else campaign.verdict(limit, certificate=certificate, thinking=settings.thinking)
        )
        bound = None if verdict is None else verdict.certificate
        if verdict is None and not settings.explores:
            with suppress(CertificateError):
                bound = campaign.certify(certificate=certificate, thinking=settings.thinking)
        report: dict[str, Any] = {"case": experiment.name, "search": settings.search.type, "seed": settings.seed}
        report |= {"budget": total, "units": experiment.units, **_summary(campaign, verdict, bound)}
        report |= {"store": str(path), "other_stores": [str(other.path) for other in other_stores(path)]}
        report |= {"options": settings.options} if settings.options else {}
        report |= {} if campaign.sensitivity is None else {"sensitivity": campaign.sensitivity.to_json()}
        trusted = None
        if envelope and limit is not None:
            trusted = campaign.envelope(
                limit, certificate.confidence, certificate=certificate, thinking=settings.thinking
            )
            report["envelope"] = trusted.to_json()
        result = {"verdict": None if verdict is None else verdict.to_json(), "budget": total}
        if with_report:
            page = path.with_suffix(".report.html")
            # An earlier run may have written the same report.
            current = page.is_file() and campaign.store.computed(base.RUN) == {**result, "report": str(page)}
            try:
                if not current:
                    from ctxval import report as reports  # imported here, because a finished campaign has one

                    context = reports.context_of_campaign(
                        campaign, verdict, budget=total, envelope=trusted, thinking=settings.thinking
                    )
                    reports.write_page(context, page)
                report["report"] = str(page)
            except Exception as error:  # it must not hide the verdict, for which executions were paid
                err.say(f"no report: {reason_of(error)}")
                report["report"] = None
        campaign.store.keep_computed(base.RUN, {**result, "report": report.get("report")}, digest)
        if shown is not None:
            shown.end(verdict, bound, report.get("report"))
    _print_result(campaign, report, verdict, bound, trusted)
    if campaign.failed and not campaign.completed and not base.status_of(verdict):
        why = "`ctxval why` looks for a cause in what was recorded before the failures."
        err.say(base.ERROR, f"all {len(campaign.failed)} executions failed, so there is no distance. {why}")
        return report, base.CANNOT_GO_ON
    return report, base.status_of(verdict)


def _print_parts(experiment: Experiment, limit: float | None) -> None:
    parts = experiment.validation
    data = getattr(parts.model, "data", None)
    learned = f" from {len(data)} transitions" if isinstance(data, Transitions) and len(data) else ""
    system, model, synthesizer = (type(each).__name__ for each in (parts.system, parts.model, parts.synthesizer))
    against = "" if limit is None else f", threshold {limit:g} {experiment.units}".rstrip()
    sentence = f": S {system}, M {model}{learned}, controllers {synthesizer}{against}"
    out.say((experiment.name, "bold"), sentence, wrap=True)


def _summary(campaign: Campaign, verdict: Verdict | None, bound: Certificate | None) -> dict[str, Any]:
    unknown, estimate = dict.fromkeys(("verdict", "reason", "rests_on", "threshold")), campaign.estimate
    expected = None if verdict is None else verdict.expected
    return {
        **base.summary_of(campaign.trials),
        "controllers": designs_sentence(campaign.trials),
        "estimate": estimate,
        "interval": None if campaign.worst is None else [campaign.worst.distance, bound and bound.bound],
        **(unknown if verdict is None else verdict.to_json()),
        "certificate": None if bound is None else bound.to_json(),
        "expected": None if expected is None else asdict(expected),
    }


def _print_result(
    campaign: Campaign,
    report: dict[str, Any],
    verdict: Verdict | None,
    bound: Certificate | None,
    trusted: Envelope | None,
) -> None:
    if verdict is not None:
        base.print_verdict(verdict, report["units"])
    if trusted is not None:
        from ctxval.cli.stores import print_envelope  # imported here, because it loads the reports

        print_envelope(trusted)
    if verdict is None and bound is not None:
        print_table({"certificate": bound.doubt or bound.statement})
    elif verdict is None and report["controllers"]:  # a verdict says it
        out.say(f"{report['controllers']}.", wrap=True)
    if bound is not None:
        base.print_left_out(bound.details.get("thinking"))
    base.print_failures(report["failures"])
    failed = f", of which {report['failed']} failed" if report["failed"] else ""
    rows = {"executions": f"{report['executions']} of at most {report['budget']}{failed}"}
    rows |= {key: report[key] for key in ("worst", "store", "report") if key in report}
    if verdict is not None and verdict.answer == "falsified":
        advice = [f"`{shlex.join(['ctxval', 'why', report['store']])}` tells what M lacks"]
        if trusted is None and campaign.recorder.search.uses_prediction:
            advice.append("the same command with --envelope finds where M holds")
        rows["next"] = "; ".join([*advice, "`ctxval refine` learns a better model"])
    print_table(rows, report["units"])
    if verdict is not None:
        base.print_other_stores(report["other_stores"])


@contextmanager
def _pool(parallel: Parallel, dask: str | None) -> Iterator[dict[str, Any]]:
    if dask is None:
        yield vars(parallel)
        return
    distributed = require_extra("distributed", "dask", "--dask needs")
    with reworded(f"there is no Dask scheduler at {dask}"):
        client = distributed.Client(dask, timeout=10)
    with client:
        threads = sum(client.nthreads().values())
        if not threads:
            raise InputError(f"the Dask scheduler at {dask} has no workers.")
        executor = client.get_executor(pure=False)
        yield {**vars(parallel), "workers": parallel.workers or threads, "executor": executor}


@contextmanager
def _live_page(parts: tuple[Any, ...], settings: ExperimentSettings) -> Iterator[LiveCampaign]:
    web, search = require_extra("ctxval.web.server", "web", "the page needs"), None
    from ctxval.web.jobs import ServedCampaign  # imported here, because it loads the charts

    served = ServedCampaign(*parts)
    if not settings.explores:
        ending = served.budget, served.threshold, settings.within
        search = interval_search(served.campaign.recorder, served.certificate, *ending)
    page = web.LiveCampaign(served, search)
    with web.showing(page) as address, also_listening(page.hear):
        (err if out.quiet else out).say(f"the page is at {address}")
        screen = sys.platform in ("win32", "darwin") or {"DISPLAY", "WAYLAND_DISPLAY"} & os.environ.keys()
        if sys.stdout.isatty() and screen:
            webbrowser.open(address)
        yield page
