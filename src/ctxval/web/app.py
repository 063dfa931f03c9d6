"""The operator's page as an ASGI application, and its forms; what cannot be read is refused in one sentence."""

from __future__ import annotations

import asyncio
import contextlib
import io
import math
import tempfile
import zipfile
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from pathlib import Path

import numpy as np
from python_multipart.exceptions import FormParserError
from starlette.applications import Starlette
from starlette.datastructures import UploadFile
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import HTMLResponse, RedirectResponse, Response, StreamingResponse
from starlette.routing import BaseRoute, Mount, Route
from starlette.staticfiles import StaticFiles

from ctxval._util.checked import NonNegativeFloat, require
from ctxval._util.texts import Number, number_in, shortened, visible
from ctxval.campaign.telling import SuppliedResult
from ctxval.core.space import TaskSpace
from ctxval.core.task_suite import TASK, TaskSuite
from ctxval.errors import CampaignError, CtxvalError, InputError, StoreError
from ctxval.web.jobs import TaskRequest
from ctxval.web.page import Page, Problem
from ctxval.web.security import Access, Guard, Hosts
from ctxval.web.service import CampaignService
from ctxval.web.state import PageState

_OUT_OF_DATE = (
    "the server was started again after this page was loaded. Send the form once more; a file must be chosen again."
)

Handler = Callable[[Request, str], Awaitable[Response]]


Fields = Mapping[str, str]  #: the fields of a form that are texts


class PageRoutes:
    """The routes of a page that shows a campaign, and takes nothing."""

    def __init__(self, state: PageState, access: Access) -> None:
        self.state, self.access, self.page = state, access, Page(state)

    def routes(self) -> list[BaseRoute]:
        """Return all routes; every one but the static files and the entrance needs a session."""
        return [
            Route("/", self._start, methods=["GET"]),
            Route("/enter", self._enter, methods=["POST"]),
            Mount("/static", StaticFiles(packages=[("ctxval.web", "static"), ("ctxval.report", "assets")])),
            Route("/events", self._inside(self._events), methods=["GET"]),
        ]

    async def _start(self, request: Request) -> Response:
        token = request.query_params.get("token")
        return await (self._inside(self._campaign)(request) if token is None else self._admit(token))

    async def _enter(self, request: Request) -> Response:
        async with _form(request, max_files=0, max_fields=4) as (fields, _):
            return await self._admit(fields.get("token", "").strip())

    async def _admit(self, token: str) -> Response:
        if not self.access.needs_token:
            return RedirectResponse("/", 303)
        if not self.access.admits(token):
            await asyncio.sleep(0.5)
            return HTMLResponse(self.page.render("enter.html", sentence="This is not the token of this server."), 401)
        # A redirect after a link from another site would not send the strict cookie; a page that goes on does.
        page = self._message("Welcome", "The page of the campaign opens.", 200, forward=True)
        return self._with_cookie(page, self.access.new_session()[1])

    def _message(self, title: str, sentence: str, status: int = 404, *, forward: bool = False) -> Response:
        page = self.page.render("message.html", title=title, sentence=sentence, forward=forward)
        return HTMLResponse(page, status)

    def _with_cookie(self, response: Response, cookie: str) -> Response:
        response.set_cookie(self.access.cookie, cookie, httponly=True, samesite="strict", path="/")
        return response

    def _inside(self, handler: Handler) -> Callable[[Request], Awaitable[Response]]:
        """Return a handler that is called with the name of the session.

        A browser that needs no token gets a new session. If the page was open while the server was started again, the
        token of its form is not one of that session, so the form is refused with its fields kept.
        """

        async def handle(request: Request) -> Response:
            session = self.access.session(request.cookies)
            if session is not None:
                return await handler(request, session)
            if self.access.needs_token:
                ended = None if request.url.path == "/" else "Your session has ended. Nothing was stored."
                return HTMLResponse(self.page.render("enter.html", sentence=ended), 401)
            session, cookie = self.access.new_session()
            return self._with_cookie(await handler(request, session), cookie)

        return handle

    async def _campaign(self, request: Request, session: str, problem: Problem | None = None) -> Response:
        self.state.shown = self.state.version
        replaces = problem is not None and "replace" in problem.fields
        page = self.page.campaign(
            self.access.form_token(session),
            problem=problem,
            told=_count(request.query_params.get("told", "")),
            replaced=request.path_params["number"] if replaces else _count(request.query_params.get("replace", "")),
            all_="all" in request.query_params,
        )
        return HTMLResponse(page, 200 if problem is None else problem.status)

    async def _events(self, request: Request, session: str) -> Response:
        if self.state.listeners >= 64:
            return Response("too many pages are open", 503, media_type="text/plain")
        return StreamingResponse(self.state.events(), media_type="text/event-stream")


class OperatorPage(PageRoutes):
    """The routes of a page that also takes what operators do."""

    def __init__(self, service: CampaignService, access: Access) -> None:
        super().__init__(service, access)
        self.service = service

    def routes(self) -> list[BaseRoute]:
        return [
            *super().routes(),
            Route("/choose", self._inside(self._choose), methods=["POST"]),
            Route("/trials/{number:int}/{kind}", self._inside(self._tell), methods=["POST"]),
            Route("/trials/{number:int}/files.zip", self._inside(self._file), methods=["GET"]),
            Route("/trials/{number:int}/files/{name}", self._inside(self._file), methods=["GET"]),
        ]

    async def _choose(self, request: Request, session: str) -> Response:
        async with _form(request, max_files=0, max_fields=1_000, max_part_size=4096) as (fields, _):
            allowed = self.access.allows_form(session, fields.get("token", ""))
        if not allowed:
            return await self._campaign(request, session, Problem("choose", _OUT_OF_DATE, fields, 403))
        status = 422
        try:
            wanted = task_request(fields, self.service.served.campaign.validation.space)
            status = 409
            self.service.choose(wanted)
        except InputError as error:
            return await self._campaign(request, session, Problem("choose", str(error), fields, status))
        return RedirectResponse("/#next", 303)

    async def _tell(self, request: Request, session: str) -> Response:
        number, kind = request.path_params["number"], request.path_params["kind"]
        if kind not in ("recording", "distance", "failure"):
            return self._message("Not found", "There is no such page.")
        fields: dict[str, str] = {}
        try:
            async with _form(request, max_files=1, max_fields=20, max_part_size=65_536) as (fields, upload):
                if self.access.allows_form(session, fields.get("token", "")):
                    await self._record(number, kind, fields, upload)
                    return RedirectResponse(f"/?told={number}#message", 303)
            sentence, status = _OUT_OF_DATE, 403
        except HTTPException as error:
            sentence, status = f"the form cannot be read: {error.detail}", error.status_code
        except CtxvalError as error:
            sentence, status = shortened(str(error)), 500 if isinstance(error, StoreError | CampaignError) else 422
            ended = None if "replace" in fields else self.page.ended(number)
            if ended is not None:
                sentence, status = f"a result of this trial is recorded already: {ended}.", 409
        # The problem is shown in its form, or at the top of the page if the form is not on it any more.
        snapshot = self.service.snapshot
        shown = [trial for trial in snapshot.trials if trial.told] if "replace" in fields else snapshot.trials.open
        where = f"{kind}-{number}" if any(trial.number == number for trial in shown) else "trial"
        return await self._campaign(request, session, Problem(where, sentence, fields, status))

    async def _record(self, number: int, kind: str, fields: dict[str, str], upload: object) -> None:
        with tempfile.TemporaryDirectory(prefix="ctxval-") as folder:
            path = None
            if isinstance(upload, UploadFile) and upload.filename:
                path = recording_in(folder, upload.filename)
                path.write_bytes(await upload.read())
            try:
                await self.service.tell(number, result(kind, fields, path), fields.get("submission", ""))
            except InputError as error:
                # The operator knows the name of the file, not the folder in which it is read.
                raise InputError(str(error).replace(f"{folder}/", "")) from error

    async def _file(self, request: Request, session: str) -> Response:
        number, name = request.path_params["number"], request.path_params.get("name")
        try:
            files = await self.service.files_of(number)
        except CtxvalError as error:
            return self._message("No file", str(error))
        if name is None:
            packed = io.BytesIO()
            with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
                for each, data in files.items():
                    archive.writestr(f"trial-{number}/{each}", data)
            content, title = packed.getvalue(), f"trial-{number}.zip"
        elif name in files:
            content, title = files[name], f"trial-{number}-{name}"
        else:
            sentence = f"There is no file {visible(name)[:80]} of trial {number}; there are {', '.join(files)}."
            return self._message("No file", sentence)
        headers = {"Content-Disposition": f'attachment; filename="{title}"'}
        return Response(content, media_type="application/octet-stream", headers=headers)


def _count(text: str) -> int | None:
    return int(text) if text.isdecimal() and len(text) < 10 else None


@contextlib.asynccontextmanager
async def _form(request: Request, **limits: int) -> AsyncIterator[tuple[dict[str, str], object]]:
    """Yield the texts and the file of a form; not every version of starlette refuses a damaged one."""
    try:
        async with request.form(**limits) as form:
            yield {name: value for name, value in form.items() if isinstance(value, str)}, form.get("file")
    except FormParserError as error:
        raise HTTPException(400, "it is damaged") from error


# Forms


def task_request(fields: Fields, space: TaskSpace) -> TaskRequest:
    seen = _read(fields, "seen", "the number of trials on the page must be a whole number", int)
    match fields.get("how"):
        case "next":
            return TaskRequest(trials=seen)
        case "decides":
            return TaskRequest(decides=True, trials=seen)
        case "draw":
            return TaskRequest(draw=True, trials=seen)
        case "own" if isinstance(space, TaskSuite):
            named = {TASK: fields.get(TASK, "")}
            space.point(named)
            return TaskRequest(named, trials=seen)
        case "own":
            point = np.array([_number(fields, f"parameter-{place}", name) for place, name in enumerate(space.names)])
            parameters = space.describe_point(point)
            space.point(parameters)
            return TaskRequest(parameters, trials=seen)
        case "again":
            number = _read(fields, "trial", "the trial must be a whole number", int)
            return TaskRequest(again=number, because=fields.get("because", "").strip() or None, trials=seen)
    raise InputError("choose how the next task is to be found.")


def result(kind: str, fields: Fields, recording: Path | None) -> SuppliedResult:
    replace = fields.get("replace")
    if kind == "failure":
        reason = fields.get("reason", "").strip()
        if not reason:
            raise InputError('a failure needs a reason, such as "the motor cut out".')
        return SuppliedResult(failed=reason, replace=replace)
    if kind == "distance":
        return SuppliedResult(distance=_number(fields, "distance", "the distance"), replace=replace)
    if recording is None:
        raise InputError("choose the file of the recording.")
    start = _number(fields, "tolerance", "the start tolerance") if fields.get("tolerance", "").strip() else None
    require("the start tolerance", NonNegativeFloat | None, start)
    resample, failed = "resample" in fields, fields.get("reason", "").strip() or None
    return SuppliedResult(
        recording, failed=failed, resample=resample, start_tolerance=start, replace=replace, uploaded=True
    )


def _number(fields: Fields, field: str, name: str) -> float:
    return _read(fields, field, f"{name} must be a number", float)


def _read(fields: Fields, field: str, sentence: str, kind: type[Number]) -> Number:
    given = fields.get(field, "").strip()
    with contextlib.suppress(ValueError, OverflowError):  # a whole number may be too large for a float
        value = number_in(given, kind)
        if math.isfinite(value):
            return value
    raise InputError(f"{sentence}, got {given[:60]!r}.")


def recording_in(folder: str, name: str) -> Path:
    """Return the path for an uploaded recording: its own name without anything that is not plain."""
    base = name.replace("\\", "/").rpartition("/")[2]
    plain = "".join(letter if letter.isalnum() or letter in "._- " else "_" for letter in base)[-80:].lstrip(".")
    return Path(folder) / (plain or "recording.csv")


def application(state: PageState, access: Access, hosts: Hosts) -> Guard:
    @contextlib.asynccontextmanager
    async def running(app: Starlette) -> AsyncIterator[None]:
        await state.start()
        try:
            yield
        finally:
            await state.stop()

    page = OperatorPage(state, access) if isinstance(state, CampaignService) else PageRoutes(state, access)
    return Guard(Starlette(routes=page.routes(), lifespan=running), hosts, access)
