"""The page of a campaign that a command executes: it shows what the command knows, and takes nothing."""

from __future__ import annotations

import asyncio
import threading
import time
from typing import Any

from ctxval._util.progress import Progress
from ctxval.campaign.interval_search import IntervalSearch
from ctxval.certificates import Certificate, Verdict
from ctxval.core.trial import Trial
from ctxval.web import jobs
from ctxval.web.background import Innermost
from ctxval.web.served import ServedCampaign
from ctxval.web.state import PageState, Work


class LiveCampaign(PageState):
    """The state of a campaign that this process executes in another thread.

    The thread of the campaign calls ``hear``, :meth:`take` and :meth:`end`; the rest belongs to the server. There
    is no search if the campaign explores.
    """

    live = True

    def __init__(self, served: ServedCampaign, search: IntervalSearch | None) -> None:
        super().__init__(served, served.snapshot())
        self._search = search
        self.hear = Innermost(self._follow_progress("choosing"))
        self._drawn = self._cost = 0.0
        self.started = threading.Event()

    async def start(self) -> None:
        """Begin to follow the campaign."""
        await super().start()
        self._spawn(self._watch())
        self.started.set()

    # In the thread of the campaign

    def take(self, trial: Trial) -> None:
        """Show the interval and the pictures after a trial has ended."""
        changes: dict[str, Any] = {}
        if self._search is not None:
            low, high = self._search.interval
            bound = "not known yet" if high is None else f"{high:.4g}"
            changes["interval"] = f"from {low:.4g} to {bound} {self.served.experiment.units}".rstrip()
        begun = time.monotonic()
        if begun - self._drawn >= 10 * self._cost:  # pictures take at most about a tenth of the time
            changes["pictures"] = jobs.pictures_of(self.served)
            self._drawn = time.monotonic()
            self._cost = self._drawn - begun
        self._post(changes)

    def end(self, verdict: Verdict | None, certificate: Certificate | None, report: str | None) -> None:
        """Show the verdict, and the path of the report."""
        outcome = "the campaign has ended, and so will this page" + (f". The report is {report}" if report else "")
        shown = {"verdict": verdict, "certificate": certificate, "pictures": jobs.pictures_of(self.served)}
        self._post({**shown, "choosing": None, "interval": None, "outcome": outcome})

    def wait_until_seen(self) -> None:
        """Give open pages time to load the last state: until one has, at most 5 s, and a moment for the others."""
        end = time.monotonic() + 5
        while self.listeners and time.monotonic() < end and (self.outcome is None or self.shown < self.version):
            time.sleep(0.05)
        if self.listeners:
            time.sleep(0.5)

    def _post(self, changes: dict[str, Any]) -> None:
        self._loop.call_soon_threadsafe(lambda: self.update(**changes))

    # In the event loop of the server

    def _progressed(self, kind: str, progress: Progress) -> None:
        if self.outcome is not None:
            return
        if self.choosing is None or self.choosing.progress.stage != progress.stage:
            self.update(choosing=Work.begun(progress.stage))
        super()._progressed(kind, progress)

    async def _watch(self) -> None:
        while True:
            fresh = self.served.snapshot()
            if (fresh.signature, fresh.executions) != (self.snapshot.signature, self.snapshot.executions):
                self.snapshot = fresh
                self.update()
            await asyncio.sleep(0.5)
