"""TOML files that are written."""

from __future__ import annotations

import shlex
import subprocess
import tomllib
from pathlib import Path

from hypothesis import given
from hypothesis import strategies as st

from ctxval._util.texts import shell_word
from ctxval._util.toml import require_unedited, toml_text, write_toml
from ctxval.cli.logs import mapping_content
from ctxval.data import Field, LogMapping
from ctxval.errors import InputError
from facts import refuses

# No TOML file can hold surrogates.
NAMES = st.text(st.characters(exclude_categories=["Cs"])) | st.sampled_from(
    [
        *('a"\n[system]\ntype = "evil:Rig"\n#', "\x1b[31mred", "\u202eabc", "\u200f", "😀", "\\"),
        *('"""', "'''", "a.b", "", "\r\n", "\x7f"),
    ]
)


@given(NAMES, NAMES)
def test_any_text_is_the_same_after_it_is_written(name: str, unit: str) -> None:
    text = toml_text({"units": unit, "states": {name: unit}, "system": {"states": {name: [unit, 1.0]}}})
    assert tomllib.loads(text) == {"units": unit, "states": {name: unit}, "system": {"states": {name: [unit, 1.0]}}}
    assert text.replace("\n", "").replace("\t", "").isprintable()


def test_surrogates_become_replacement_characters() -> None:
    assert tomllib.loads(toml_text({"name": "a\ud800b"})) == {"name": "a\ufffdb"}


@given(NAMES.filter(bool), NAMES, NAMES)
def test_a_mapping_is_read_as_it_was_written(path: str, name: str, unit: str) -> None:
    mapping = LogMapping({name: Field(path, unit)}, {}, time=path)
    content = tomllib.loads(toml_text(mapping_content(mapping, 0.01)))
    assert LogMapping.from_table(content) == LogMapping({name: Field(path, unit)}, {}, time=path, dt=0.01)


def test_files_that_were_edited_are_not_replaced(tmp_path: Path) -> None:
    path = tmp_path / "mapping.toml"
    require_unedited(path)
    for value in (1, 2):
        write_toml(path, {"a": value})
        require_unedited(path)
    path.write_bytes(path.read_bytes().replace(b"\n", b"\r\n"))
    require_unedited(path)
    path.write_text(path.read_text() + "b = 3\n")
    with refuses(InputError, "mapping.toml", "--force"):
        require_unedited(path)
    path.write_text("a = 1\n")
    with refuses(InputError, "mapping.toml", "--force"):
        require_unedited(path)


@given(NAMES.filter(lambda name: "\0" not in name))
def test_a_shell_reads_the_word_that_is_printed(name: str) -> None:
    word = shell_word(name)
    assert word.isprintable()
    if name.isprintable():
        assert shlex.split(word) == [name]


def test_bash_reads_words_with_control_characters() -> None:
    for name in ("a\nb", "\x1b[31m", "it's\t\\n", "\u202eabc", "$(touch x)\n"):
        out = subprocess.run(["bash", "-c", f"printf %s {shell_word(name)}"], capture_output=True, check=True).stdout
        assert out.decode() == name
