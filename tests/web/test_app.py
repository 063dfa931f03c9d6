"""The operator's page as a server: what it answers, what it refuses, and what it stores, by plain requests."""

from __future__ import annotations

import io
import re
import signal
import time
import zipfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from urllib.parse import urlencode

import pytest

from ctxval.campaign.storage.store import Store
from ctxval.core.trial import Trial
from ctxval.web.security import HEADERS, MOST_UPLOAD
from facts import assert_names
from rig_page import Response, Server, ctxval, new_store, record, serving
from rig_thorough import more

pytestmark = pytest.mark.slow

SHORT = b"t,position,speed,force\n0,0,0,1\n0.1,0,0,1\n"
"""A recording of two times."""

KINDS = ("recording", "failure", "distance")

NAMES = ["../../evil.csv", "..\\\\evil.csv", ".csv", "a" * 300 + ".csv", "<b>.csv", "x\x01.npz"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("rig")
    new_store(made)
    return made


@pytest.fixture(scope="module")
def server(folder: Path) -> Iterator[Server]:
    with serving(folder) as running:
        yield running


@pytest.fixture
def page(server: Server) -> Response:
    return server.request("GET", "/")


def trials(folder: Path) -> list[Trial]:
    store = Store.existing(folder / "a.sqlite")
    try:
        return store.trials()
    finally:
        store.close()


def post(server: Server, path: str, page: Response, fields: dict[str, str], **headers: str | None) -> Response:
    """Send a form as the browser of the page does; headers replace those of the browser."""
    sent = {
        "Cookie": page.cookie,
        "Origin": f"http://127.0.0.1:{server.port}",
        "Sec_Fetch_Site": "same-origin",
        "Content_Type": "application/x-www-form-urlencoded",
        **headers,
    }
    return server.request("POST", path, urlencode({"token": page.token, **fields}).encode(), **sent)


def upload(
    server: Server, number: int, page: Response, content: bytes, name: str = "run.csv", **fields: str
) -> Response:
    """Send a recording as the browser does."""
    parts = [
        f'--edge\r\nContent-Disposition: form-data; name="{key}"\r\n\r\n{value}\r\n'.encode()
        for key, value in {"token": page.token, **fields}.items()
    ]
    head = f'--edge\r\nContent-Disposition: form-data; name="file"; filename="{name}"\r\n\r\n'.encode()
    body = b"".join([*parts, head, content, b"\r\n--edge--\r\n"])
    sent = {"Cookie": page.cookie, "Origin": f"http://127.0.0.1:{server.port}", "Sec_Fetch_Site": "same-origin"}
    kind = "multipart/form-data; boundary=edge"
    return server.request("POST", f"/trials/{number}/recording", body, Content_Type=kind, **sent)


def problem(response: Response) -> str:
    """Return the sentence of a page that refuses a form."""
    found = re.search(r'role="alert"[^>]*>(.*?)</p>', response.text, re.DOTALL)
    assert found is not None, response.text
    return found[1].replace("&#39;", "'").replace("&#34;", '"')


def test_every_response_has_the_security_headers(server: Server, page: Response) -> None:
    for path in ("/", "/static/page.css", "/nothing", "/events-that-are-not", "/trials/0/files/task.json"):
        answer = server.request("GET", path, Cookie=page.cookie)
        assert {name.lower() for name in HEADERS} <= {name.lower() for name in answer.headers}, path
        assert "server" not in answer.headers
    assert "'unsafe" not in page.headers["content-security-policy"]
    assert "<script>" not in page.text
    assert "style=" not in page.text


def test_the_session_is_a_cookie_that_scripts_and_other_sites_do_not_get(page: Response, server: Server) -> None:
    said = page.headers["set-cookie"].lower()
    assert "httponly" in said
    assert "samesite=strict" in said
    assert said.startswith(f"ctxval-session-{server.port}=")


@pytest.mark.parametrize("host", ["evil.example", "evil.example:80", "127.0.0.1.evil.example", "", "192.168.0.7"])
def test_another_host_is_refused(server: Server, page: Response, host: str) -> None:
    """A page of another site can direct its own name to this computer (DNS rebinding)."""
    answer = server.request("GET", "/", Host=host, Cookie=page.cookie)
    assert answer.status == 403


@pytest.mark.parametrize("host", ["localhost", "LOCALHOST:{port}", "127.0.0.1:{port}", "[::1]:{port}"])
def test_names_of_this_computer_are_accepted(server: Server, host: str) -> None:
    assert server.request("GET", "/", Host=host.format(port=server.port)).status == 200


@pytest.mark.parametrize(
    "headers",
    [
        {"Origin": "http://evil.example"},
        {"Origin": "null"},
        {"Origin": "http://127.0.0.1:1"},
        {"Sec_Fetch_Site": "cross-site"},
        {"Sec_Fetch_Site": "same-site"},
        {"Origin": None, "Sec_Fetch_Site": "cross-site"},
        {"Origin": None, "Sec_Fetch_Site": None},
    ],
)
def test_a_form_of_another_site_is_refused(
    server: Server, page: Response, folder: Path, headers: dict[str, str | None]
) -> None:
    answer = post(server, "/trials/0/failure", page, {"reason": "forged"}, **headers)
    assert answer.status == 403
    assert trials(folder)[0].state == "open"


def test_a_form_needs_the_token_of_its_session(server: Server, page: Response, folder: Path) -> None:
    other = server.request("GET", "/")
    for fields in ({"token": "x"}, {"token": ""}, {"token": other.token}, {"token": page.token[:-1] + "\udcff"}):
        sent = {name: value.encode("utf-8", "replace").decode() for name, value in fields.items()}
        answer = post(server, "/trials/0/failure", page, {"reason": "forged", **sent})
        assert answer.status == 403
        assert_names(problem(answer), "server")
    assert post(server, "/trials/0/failure", page, {"reason": "forged"}, Cookie=None).status == 403
    forged = f"{page.cookie.partition('.')[0]}.{'0' * 64}"
    assert post(server, "/trials/0/failure", page, {"reason": "forged"}, Cookie=forged).status == 403
    assert trials(folder)[0].state == "open"


def test_another_site_cannot_embed_or_read_the_page_but_may_link_to_it(server: Server, page: Response) -> None:
    fetched = {"Sec_Fetch_Site": "cross-site", "Sec_Fetch_Mode": "no-cors", "Sec_Fetch_Dest": "image"}
    assert server.request("GET", "/trials/0/files/task.json", Cookie=page.cookie, **fetched).status == 403
    linked = {"Sec_Fetch_Site": "cross-site", "Sec_Fetch_Mode": "navigate", "Sec_Fetch_Dest": "document"}
    assert server.request("GET", "/", Cookie=page.cookie, **linked).status == 200
    framed = {**linked, "Sec_Fetch_Dest": "iframe"}
    assert server.request("GET", "/", Cookie=page.cookie, **framed).status == 403


def test_an_upload_that_is_too_large_is_refused_while_it_arrives(server: Server, page: Response, folder: Path) -> None:
    sent = {
        "Cookie": page.cookie,
        "Origin": f"http://127.0.0.1:{server.port}",
        "Sec_Fetch_Site": "same-origin",
        "Content_Type": "multipart/form-data; boundary=edge",
    }
    declared = server.request("POST", "/trials/0/recording", b"", Content_Length=str(MOST_UPLOAD + 1), **sent)
    assert (declared.status, "too large" in declared.text) == (413, True)
    delivered = 0

    def endless() -> Iterator[bytes]:
        nonlocal delivered
        yield b'--edge\r\nContent-Disposition: form-data; name="file"; filename="a.csv"\r\n\r\n'
        while delivered <= 2 * MOST_UPLOAD:
            delivered += 2**20
            yield bytes(2**20)

    try:
        answer = server.request("POST", "/trials/0/recording", endless(), **sent)
    except (BrokenPipeError, ConnectionResetError):
        pass  # the server has closed the connection
    else:
        assert answer.status == 413
    assert delivered < 2 * MOST_UPLOAD
    assert trials(folder)[0].state == "open"
    assert server.request("GET", "/").status == 200


@pytest.mark.parametrize(
    ("kind", "fields", "facts"),
    [
        ("failure", {"reason": "  "}, ("failure",)),
        ("distance", {"distance": "far"}, ("distance", "far")),
        ("distance", {"distance": "nan"}, ("distance", "nan")),
        ("distance", {"distance": "-1"}, ("distance",)),
        ("recording", {}, ("recording",)),
    ],
)
def test_a_form_that_cannot_be_used_is_refused_in_place(
    server: Server, page: Response, folder: Path, kind: str, fields: dict[str, str], facts: tuple[object, ...]
) -> None:
    answer = post(server, f"/trials/0/{kind}", page, fields)
    assert answer.status == 422
    assert_names(problem(answer), *facts)
    assert f'id="{kind}-0-problem"' in answer.text
    assert trials(folder)[0].state == "open"


@pytest.mark.parametrize(
    ("content", "fields", "facts"),
    [
        # Nothing of the file is in the sentence, because whoever sends a file may not learn what is in another one.
        (b"", {}, ("run.csv",)),
        (SHORT, {}, (21,)),
        *more(  # in test_recording_process.py, too
            (
                b"a,b\n1,2\n3,4\n",
                {},
                ("run.csv",),
            ),
            (b"t,position,speed,force\n0,0,0,1\n0.1,0,x,1\n0.2,0,0,1\n", {}, ("run.csv", 3)),
            (b"\x00\xff\xfe", {}, ("run.csv",)),
            (b"t,position [ft],speed,force\n0,0,0,1\n0.1,0,0,1\n", {}, ("run.csv",)),
        ),
        (
            b"t,position,speed,force\n0,0,0,1\n0.1,0,0,1\n",
            {"tolerance": "wide"},
            ("tolerance",),
        ),
        (b"t,position,speed,force\n0,0,0,1\n0.1,0,0,1\n", {"tolerance": "-1"}, ("tolerance",)),
        (b"t,position,speed,force\n0,0,0,1\n0.1,0,0,1\n", {"resample": "on"}, (0, 2)),
    ],
)
def test_a_wrong_file_is_refused_as_tell_refuses_it(
    server: Server, page: Response, folder: Path, content: bytes, fields: dict[str, str], facts: tuple[object, ...]
) -> None:
    answer = upload(server, 0, page, content, **fields)
    assert answer.status == 422
    assert_names(problem(answer), *facts)
    assert "/tmp" not in problem(answer)
    assert trials(folder)[0].state == "open"


def test_an_upload_that_leads_to_a_file_of_the_user_is_refused(
    server: Server, page: Response, folder: Path, tmp_path: Path
) -> None:
    h5py = pytest.importorskip("h5py")
    (tmp_path / "key").write_bytes(b"secret of a user" * 16)
    with h5py.File(tmp_path / "run.mat", "w", userblock_size=512) as file:
        for name in ("t", "position", "speed", "force"):
            file.create_dataset(name, (21,), "u1", external=[(str(tmp_path / "key"), 0, 21)])
    answer = upload(server, 0, page, (tmp_path / "run.mat").read_bytes(), "run.mat")
    assert answer.status == 422
    assert_names(problem(answer), "run.mat")
    assert trials(folder)[0].state == "open"


@pytest.mark.parametrize(
    "name", ["../../evil.csv", "a" * 300 + ".csv", "<b>.csv", "x\x01.npz", *more("..\\\\evil.csv", ".csv")]
)
def test_the_name_of_an_upload_leads_nowhere(server: Server, page: Response, name: str) -> None:
    answer = upload(server, 0, page, b"nothing", name)
    assert answer.status in (400, 422)
    assert "<b>" not in answer.text
    assert "../" not in problem(answer)


def test_nonsense_is_refused(server: Server, page: Response) -> None:
    assert post(server, "/trials/0/nothing", page, {}).status == 404
    assert post(server, "/trials/99999999999999999999/failure", page, {"reason": "a"}).status == 422
    assert post(server, "/trials/7/failure", page, {"reason": "a"}).status == 422
    assert post(server, "/choose", page, {"seen": "1"}).status == 422
    assert post(server, "/choose", page, {"how": "own", "seen": "1", "parameter-0": "9"}).status == 422
    assert post(server, "/choose", page, {"how": "again", "seen": "1", "trial": "x"}).status == 422
    broken = server.request(
        "POST",
        "/trials/0/recording",
        b"nothing",
        Cookie=page.cookie,
        Origin=f"http://127.0.0.1:{server.port}",
        Content_Type="multipart/form-data; boundary=edge",
    )
    assert broken.status == 400
    problem(broken)
    assert server.request("GET", f"/trials/{'1' * 5000}/files.zip", Cookie=page.cookie).status == 414
    for path in (
        "/trials/0/files/..%2f..%2fa",
        "/trials/3/files/task.json",
        "/static/..%2fapp.py",
    ):
        assert server.request("GET", path, Cookie=page.cookie).status == 404, path
    assert server.request("DELETE", "/", Cookie=page.cookie, Origin=f"http://127.0.0.1:{server.port}").status == 405


def test_files_are_those_that_ask_writes(server: Server, page: Response, folder: Path) -> None:
    archive = server.request("GET", "/trials/0/files/task.json", Cookie=page.cookie)
    assert archive.text == (folder / "a.trials" / "0" / "task.json").read_text()
    assert archive.headers["content-disposition"] == 'attachment; filename="trial-0-task.json"'


def wait_for(server: Server, text: str, page: Response, seconds: float = 60) -> str:
    """Load the page again until it has a text."""
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        found = server.request("GET", "/", Cookie=page.cookie).text
        if text in found:
            return found
        time.sleep(0.1)
    raise AssertionError(f"{text!r} is not in {found}")


def test_a_campaign_by_hand_by_forms_alone(tmp_path: Path) -> None:
    new_store(tmp_path)
    recording = record(tmp_path / "a.trials" / "0", tmp_path / "run.csv").read_bytes()
    with serving(tmp_path) as server:
        page = server.request("GET", "/")
        told = upload(server, 0, page, recording, submission="one")
        assert (told.status, told.headers["location"]) == (303, "/?told=0#message")
        again = upload(server, 0, page, recording, submission="one")
        assert again.status == 303  # the same form, sent twice
        second = upload(server, 0, page, recording, submission="two")
        assert second.status == 409
        assert_names(problem(second), "trial", 0, "distance")

        asked = post(server, "/choose", page, {"how": "next", "seen": "1"})
        assert asked.status == 303
        wait_for(server, 'id="trial-1"', page)
        stale = post(server, "/choose", page, {"how": "next", "seen": "1"})
        assert (stale.status, "as trial 1" in problem(stale)) == (409, True)
        assert post(server, "/trials/1/failure", page, {"reason": "motor stalled"}).status == 303

        asked = post(
            server, "/choose", page, {"how": "again", "trial": "1", "because": "motor <replaced>", "seen": "2"}
        )
        assert asked.status == 303
        assert "motor &lt;replaced&gt;" in wait_for(server, 'id="trial-2"', page)
        assert post(server, "/trials/2/distance", page, {"distance": "0.04"}).status == 303
        assert post(server, "/choose", page, {"how": "own", "parameter-0": "1.5", "seen": "3"}).status == 303
        wait_for(server, 'id="trial-3"', page)
        assert post(server, "/choose", page, {"how": "draw", "seen": "4"}).status == 303
        wait_for(server, 'id="trial-4"', page)
        wait_for(server, 'class="chart"', page)
        archive = zipfile.ZipFile(io.BytesIO(server.request("GET", "/trials/3/files.zip", Cookie=page.cookie).content))
        files = [f"trial-3/{name}" for name in ("controller.json", "controller.npz", "model.csv", "task.json")]
        assert sorted(archive.namelist()) == files
        before = b"\n".join(recording.splitlines()[:9])  # a header and eight samples
        assert upload(server, 4, page, before, reason="hit stop").status == 303
        wait_for(server, "hit stop", page)

        archive.extractall(tmp_path)
        lines = record(tmp_path / "trial-3", tmp_path / "idle.csv").read_text().splitlines()
        idle = "\n".join([lines[0], *(f"{line.rpartition(',')[0]},0" for line in lines[1:])])
        assert upload(server, 3, page, idle.encode(), submission="three").status == 303
        shown = server.request("GET", "/?told=3", Cookie=page.cookie).text
        assert_names(shown, 0, "N")
        status, said = server.stop()
    assert status == 130
    assert_names(said, "stored")
    stored = trials(tmp_path)
    assert [(trial.state, trial.origin) for trial in stored] == [
        ("completed", "initial"),
        ("failed", "acquisition"),
        ("completed", "manual"),
        ("completed", "manual"),
        ("failed", "iid"),
    ]
    assert stored[2].because == "motor <replaced>"
    assert stored[3].parameters == {"goal": 1.5}


@pytest.mark.thorough
def test_a_wrong_result_is_replaced_with_a_reason(tmp_path: Path) -> None:
    new_store(tmp_path)
    recording = record(tmp_path / "a.trials" / "0", tmp_path / "run.csv").read_bytes()
    with serving(tmp_path) as server:
        page = server.request("GET", "/")
        early = post(server, "/trials/0/distance", page, {"distance": "0.5", "replace": "a typing error"})
        assert early.status == 422
        problem(early)
        assert post(server, "/trials/0/distance", page, {"distance": "0.9"}).status == 303
        assert 'href="/?replace=0#replace-0"' in server.request("GET", "/", Cookie=page.cookie).text
        shown = server.request("GET", "/?replace=0", Cookie=page.cookie).text
        assert [f'id="replace-{kind}-0" name="replace" required' in shown for kind in KINDS] == [True] * 3
        assert 'id="replace-' not in server.request("GET", "/?replace=7", Cookie=page.cookie).text

        blank = upload(server, 0, page, recording, replace=" ")
        assert blank.status == 422
        assert_names(problem(blank), "replace", "reason")
        assert 'id="recording-0-problem"' in blank.text
        wrong = upload(server, 0, page, SHORT, replace="the <first> run")
        assert wrong.status == 422
        assert_names(problem(wrong), 21)
        assert "the &lt;first&gt; run" in wrong.text
        for _ in range(2):  # the same form, sent twice
            told = upload(server, 0, page, recording, replace="the <first> run", submission="one")
            assert (told.status, told.headers["location"]) == (303, "/?told=0#message")
        failed = post(server, "/trials/0/failure", page, {"reason": "motor stalled", "replace": "not a run"})
        assert failed.status == 303
    (trial,) = trials(tmp_path)
    assert (trial.state, trial.failure, trial.executed) == ("failed", "motor stalled", True)
    store = Store.existing(tmp_path / "a.sqlite")
    store.history()
    assert [change.content["before"]["0"]["distance"] == 0.9 for change in store.history()] == [True, False]
    store.close()


@pytest.mark.thorough
@pytest.mark.parametrize(("how", "options"), [("next", ("--explore",)), ("decides", ())])
def test_the_choices_are_those_of_the_command_line(tmp_path: Path, how: str, options: tuple[str, ...]) -> None:
    by_hand, by_page = tmp_path / "hand", tmp_path / "page"
    for folder in (by_hand, by_page):
        folder.mkdir()
        new_store(folder)
    for number in range(2):
        ctxval("tell", "a.sqlite", str(number), "--distance", "0.25", folder=by_hand)
        ctxval("ask", "a.sqlite", *options, folder=by_hand)
    with serving(by_page, "--budget", "9") as server:
        page = server.request("GET", "/")
        assert 'value="decides"' in page.text  # the experiment has a threshold
        for number in range(2):
            assert post(server, f"/trials/{number}/distance", page, {"distance": "0.25"}).status == 303
            assert post(server, "/choose", page, {"how": how, "seen": str(number + 1)}).status == 303
            wait_for(server, f'id="trial-{number + 1}"', page)
        if how == "decides":  # no task is opened for a verdict that is reached
            assert post(server, "/trials/2/distance", page, {"distance": "2.5"}).status == 303
            assert post(server, "/choose", page, {"how": how, "seen": "3"}).status == 303
            found = wait_for(server, 'class="done">The verdict is reached', page)
            assert_names(found, 3, 9)
    for one, other in zip(trials(by_hand), trials(by_page), strict=True):
        assert one.unit_point.tobytes() == other.unit_point.tobytes()
        assert one.note == other.note


def test_other_computers_need_the_token_and_the_store_may_be_run_elsewhere(tmp_path: Path) -> None:
    new_store(tmp_path)
    elsewhere = Store.existing(tmp_path / "a.sqlite")
    allowed = ("--allow-host", "rig.example", "--threshold", "0.5")
    with serving(tmp_path, "--host", "0.0.0.0", *allowed) as server:
        token = server.address.partition("?token=")[2]
        assert len(token) == 32
        bare = server.request("GET", "/")
        assert (bare.status, "set-cookie" in bare.headers, "Trial 0" in bare.text) == (401, False, False)
        for path in ("/events", "/trials/0/files/task.json"):
            assert server.request("GET", path).status == 401
        wrong = server.request("GET", "/?token=" + token[:-1])
        assert (wrong.status, "set-cookie" in wrong.headers) == (401, False)
        entered = server.request("GET", f"/?token={token}", Host=f"192.168.1.5:{server.port}")
        assert (entered.status, token in entered.text) == (200, False)
        page = server.request("GET", "/", Cookie=entered.cookie)
        assert (page.status, "Trial 0" in page.text) == (200, True)
        origin = f"http://127.0.0.1:{server.port}"
        typed = {"Origin": origin, "Content_Type": "application/x-www-form-urlencoded"}
        assert server.request("POST", "/enter", f"token={token}".encode(), **typed).status == 200
        assert server.request("POST", "/enter", b"token=guess", **typed).status == 401
        assert server.request("GET", "/", Host="evil.example", Cookie=entered.cookie).status == 403
        named = server.request("GET", "/", Host="rig.example", Cookie=entered.cookie)
        assert (named.status, "0.5 m" in wait_for(server, "against 0.5 m", entered)) == (200, True)

        page = replace(page, headers={**page.headers, "set-cookie": entered.headers["set-cookie"]})
        with elsewhere.sole_writer():
            assert post(server, "/choose", page, {"how": "next", "seen": "1"}).status == 303
            found = wait_for(server, "waiting for another process that is running the store", page)
            assert 'id="trial-0"' in found
            assert post(server, "/trials/0/distance", page, {"distance": "0.25"}).status == 303
        wait_for(server, 'id="trial-1"', page)
        ctxval("tell", "a.sqlite", "1", "--failed", "the cable broke", folder=tmp_path)
        wait_for(server, "the cable broke", page)
    elsewhere.close()
    assert [trial.state for trial in trials(tmp_path)] == ["completed", "failed"]


@pytest.mark.thorough
def test_the_server_ends_at_once_although_a_task_is_being_chosen(tmp_path: Path) -> None:
    new_store(tmp_path, "my_rig:slow")
    recording = record(tmp_path / "a.trials" / "0", tmp_path / "run.csv").read_bytes()
    with serving(tmp_path) as server:
        page = server.request("GET", "/")
        assert upload(server, 0, page, recording).status == 303
        assert post(server, "/choose", page, {"how": "next", "seen": "1"}).status == 303
        wait_for(server, "choosing a task", page)
        server.process.send_signal(signal.SIGINT)
        time.sleep(0.2)
        status, _ = server.stop()
    assert status in (130, -signal.SIGINT)  # the second one may come when Python itself is ending
    assert [trial.state for trial in trials(tmp_path)] == ["completed"]
