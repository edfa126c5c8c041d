"""A small site, built once: its links lead somewhere, nothing is loaded from elsewhere, all public names are described."""

from __future__ import annotations

import importlib.util
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest
from conftest import REPOSITORY

import nsmodel
import nsmodel.crowd
import nsmodel.plot
from nsmodel.cli import _parser
from nsmodel.hypotheses.equations import model_equations
from nsmodel.modeling import model_files

pytestmark = pytest.mark.skipif(
    any(importlib.util.find_spec(name) is None for name in ("sphinx", "furo", "myst_nb")), reason="no Sphinx: extra docs"
)
EVIL = """</script><b>x</b> & "y" *z* `q` [l](https://example.org) $m$ {eval-rst} |s|_ a\\b"""
LOADED = {("script", "src"), ("img", "src"), ("iframe", "src"), ("source", "src"), ("link", "href")}


class Page(HTMLParser):
    """What a page refers to, what can be referred to in it, and its text by elements."""

    def __init__(self, path):
        super().__init__()
        self.path, self.ids, self.links, self.loads, self.open, self.text = path, {""}, [], [], [], []
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag, attributes):
        self.open.append(tag)
        found = dict(attributes)
        self.ids.add(found.get("id", ""))
        for name in ("href", "src"):
            if found.get(name):
                is_loaded = (tag, name) in LOADED and found.get("rel") not in ("index", "search", "next", "prev")
                (self.loads if is_loaded else self.links).append(found[name])

    def handle_data(self, data):
        self.text.append((self.open[-1] if self.open else "", data))

    def of(self, tag):
        """The text that stands right in such elements."""
        return [data for name, data in self.text if name == tag]


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The folder of a small site; of several processes that run these tests the first one builds it."""
    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "small-site"
    said = folder / "said.txt"
    try:
        folder.mkdir()
    except FileExistsError:
        while not said.exists():
            time.sleep(0.1)
    else:
        try:
            text = built(folder)
        except Exception as error:  # nobody is to wait for it
            text = repr(error)
        (folder / "part.txt").write_text(text, encoding="utf-8")
        (folder / "part.txt").rename(said)
    assert said.read_text(encoding="utf-8") == "0: "
    return folder / "site"


def built(folder):
    """Build it, with a case and a snippet whose words are full of signs: the exit status, and what was said."""
    docs = folder / "docs"
    shutil.copytree(REPOSITORY / "docs", docs, ignore=shutil.ignore_patterns("gallery", "__pycache__"))
    formulas = "Where $v = 0$ and $a < b$:\n\n$$\n\\dot x = v \\\\ y = 1\n$$\n"
    (docs / "howto_signs.md").write_text(f"# Signs\n\n{formulas}\n{case_with_signs(docs)}", encoding="utf-8")
    paths = os.pathsep.join([str(REPOSITORY), os.environ.get("PYTHONPATH", "")])
    environment = os.environ | {"PYTHONPATH": paths, "NSMODEL_SHORT": "1"}
    command = [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", "-d", "doctrees", "docs", "site"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False, cwd=folder)
    return f"{done.returncode}: {done.stdout}{done.stderr}"


def case_with_signs(docs):
    """A page of the gallery as a part of a page, with signs in all that a user may write."""
    gallery, runs = (module(docs / "_ext", name) for name in ("gallery", "runs"))
    case = model_files.Case(
        "signs", model_files.find_case("diode_bridge").path, EVIL, f"{EVIL}\n\n    {EVIL}", EVIL, EVIL, EVIL, ""
    )
    picture = docs / "images" / "mfcq.png"
    finding = {"id": EVIL, "statement": EVIL, "verdict": "holds", "how": EVIL}
    facts = {"title": EVIL, "summary": EVIL, "verdict": EVIL, "equations": [r"\dot x = v"], "findings": [finding]}
    return gallery.page(case, runs.Made(case.path, picture, picture, facts), docs).replace("\n# ", "\n## ")


def module(folder, name):
    """A module of the site's own."""
    sys.path.insert(0, str(folder))
    try:
        return importlib.import_module(name)
    finally:
        sys.path.remove(str(folder))


@pytest.fixture(scope="module")
def pages(site):
    return {path: Page(path) for path in site.rglob("*.html")}


def test_every_internal_link_leads_to_a_place_that_is_there(site, pages):
    dead = []
    for page in pages.values():
        for link in page.links + page.loads:
            parts = urlsplit(link)
            if parts.scheme or parts.netloc:
                continue
            target = (page.path.parent / unquote(parts.path)).resolve() if parts.path else page.path
            ids = pages[target].ids if target in pages else {""}
            if not target.is_file() or (target in pages and unquote(parts.fragment) not in ids):
                dead.append(f"{page.path.relative_to(site)}: {link}")
    assert dead == []


def test_nothing_is_loaded_from_elsewhere(site, pages):
    loaded = {load for page in pages.values() for load in page.loads}
    assert [load for load in loaded if urlsplit(load).scheme not in ("", "data") or load.startswith("//")] == []
    for path in site.rglob("*.css"):
        urls = re.findall(r"""(?:url\(|@import)\s*["']?([^"')]+)""", path.read_text(encoding="utf-8"))
        assert [url for url in urls if url.startswith(("http", "//"))] == [], path
        for url in urls:
            assert url.startswith(("data:", "#")) or (path.parent / url.partition("#")[0].partition("?")[0]).is_file(), url


def test_every_public_name_is_described(pages, site):
    described = set().union(*(page.ids for page in pages.values() if page.path.parent == site / "api"))
    for package in (nsmodel, nsmodel.crowd, nsmodel.plot):
        assert {f"{package.__name__}.{name}" for name in package.__all__} <= described


def test_every_option_of_every_command_is_described(pages, site):
    page = pages[site / "api" / "commands.html"]
    text = " ".join(data for _, data in page.text)
    [commands] = [
        action.choices for action in _parser()._actions if hasattr(action, "choices") and isinstance(action.choices, dict)
    ]
    for name, parser in commands.items():
        assert f"nsmodel-{name}" in page.ids
        for action in parser._actions:
            assert all(option in text for option in action.option_strings if option not in ("-h", "--help")), name


def test_a_case_has_its_picture_numbers_verdicts_and_file(pages, site):
    page = pages[site / "gallery" / "diode_bridge.html"]
    assert "Diode bridge rectifier" in page.of("h1")
    assert any(load.endswith("diode_bridge.png") for load in page.loads)
    [file] = [link for link in page.links if link.endswith("diode_bridge.py")]
    assert (page.path.parent / file).read_bytes() == model_files.find_case("diode_bridge").path.read_bytes()
    text = "".join(data for _, data in page.text)
    model = nsmodel.load(model_files.find_case("diode_bridge").path)
    assert all(" ".join(formula.split()) in " ".join(text.split()) for formula in model_equations(model))
    report = nsmodel.check(model)
    assert report.verdict in " ".join(text.split())
    for finding in report.findings:
        assert " ".join(finding.statement.split()) in " ".join(text.split())


def test_a_snippet_is_followed_by_its_picture(pages, site):
    assert any(load.endswith("friction.png") for load in pages[site / "guide.html"].loads)


def test_marks_of_tables_are_not_shown(pages, site):
    for name in ("events", "orders", "study"):
        assert not any("<!--" in data for _, data in pages[site / f"{name}.html"].text)


def test_a_case_is_linked_from_pages_as_a_page(pages, site):
    assert "gallery/diode_bridge.html" in pages[site / "index.html"].links


def test_what_users_write_is_shown_as_it_stands(pages, site):
    page = pages[site / "howto_signs.html"]
    shown = "".join(data for _, data in page.text)
    shown = " ".join(shown.split())
    assert shown.count(EVIL.replace("`q`", "q")) == 4  # prose: what is between backticks is code
    assert shown.count(EVIL) >= 6
    assert "b" not in page.open
    assert not any(link.startswith("https://example.org") for link in page.links)


def test_what_is_made_is_known_by_file_and_package(tmp_path, monkeypatch):
    runs = module(REPOSITORY / "docs" / "_ext", "runs")
    monkeypatch.syspath_prepend(REPOSITORY / "docs" / "_ext")  # for processes
    job = runs.Job("a.py", "model = 1")
    others = [runs.Job("b.py", "model = 1"), runs.Job("a.py", "model = 2"), runs.Job("a.py", "model = 1", case=True)]
    assert len({job.key, *(other.key for other in others)}) == 4
    before = job.key
    monkeypatch.setattr(runs, "package_hash", lambda: "another")
    assert job.key != before
    (tmp_path / job.key).mkdir()
    (tmp_path / job.key / "facts.json").write_text('{"title": "kept"}')
    assert [made.facts["title"] for made in runs.made([job], tmp_path)] == ["kept"]
    with pytest.raises(RuntimeError, match=r"bad\.py: ModelError: "):
        list(runs.made([job, runs.Job("bad.py", "model = 1")], tmp_path))
    runs.forget(tmp_path, [others[0]])
    assert list(tmp_path.iterdir()) == []


RUNS_JOBS = """
import runs, sys
from pathlib import Path

code = "import os, sys, time\\nfrom pathlib import Path\\n(Path(sys.argv[1]) / str(os.getpid())).touch()\\ntime.sleep(600)"
if __name__ == "__main__":
    list(runs.made([runs.Job(f"{k}.py", code) for k in range(3)], Path(sys.argv[1]) / "made"))
"""


@pytest.mark.skipif(sys.platform == "win32", reason="signals")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_who_makes_the_site_leaves_nobody_behind(tmp_path, number):
    program = tmp_path / "program.py"
    program.write_text(RUNS_JOBS)
    paths = os.pathsep.join([str(REPOSITORY / "docs" / "_ext"), str(REPOSITORY)])
    started = subprocess.Popen([sys.executable, str(program), str(tmp_path)], env=os.environ | {"PYTHONPATH": paths})
    try:
        workers = wait_for(lambda: (found := [path for path in tmp_path.iterdir() if path.name.isdigit()])[1:] and found)
    finally:
        started.send_signal(number)
        assert started.wait() == -number
    numbers = [int(path.name) for path in workers]
    assert len(numbers) == 2
    gone = wait_for(lambda: not any(map(is_running, numbers)))
    for left in filter(is_running, numbers):
        os.kill(left, signal.SIGKILL)
    assert gone


def wait_for(holds, seconds=60):
    """What it gives as soon as that is true; what it is in the end."""
    end = time.monotonic() + seconds
    while not (found := holds()) and time.monotonic() < end:
        time.sleep(0.05)
    return found


def is_running(number):
    """Whether there is a process, and not its remains alone, which its new parent has yet to take up."""
    try:
        os.kill(number, 0)
        state = Path(f"/proc/{number}/stat")
        return not state.exists() or state.read_text().rpartition(")")[2].split()[0] != "Z"
    except (ProcessLookupError, FileNotFoundError):
        return False


def test_the_search_knows_the_pages(site):
    index = (site / "searchindex.js").read_text(encoding="utf-8")
    assert all(f'"{name}"' in index for name in ("guide", "gallery/diode_bridge", "api/runs"))


def test_formulas_are_between_what_katex_looks_for(pages, site):
    page = pages[site / "howto_signs.html"]
    shown = [text.strip() for text in page.of("div") + page.of("span")]
    assert r"\[\begin{aligned}\dot x = v \\ y = 1\end{aligned}\]" in shown
    assert {r"\(v = 0\)", r"\(a < b\)"} <= set(shown)
    assert any("katex.min.js" in load for load in page.loads)
