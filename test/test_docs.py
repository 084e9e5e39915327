"""Everything public is documented, and the documents say what is there: options, parameters, topics, links, messages."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest
import yaml

from ctr_dynamics.cli import main as cli
from ctr_dynamics.diagnosis.output.findings_keys import KEYS
from ctr_dynamics.io.messages.topics import TOPICS
from ctr_dynamics.parameters import PARAMETERS
from ctr_dynamics.runtime.node_parameters import NODES
from ctr_dynamics.view.markers import TUBES_TOPIC
from tools import reference
from tools.message_pages import undocumented

ROOT = Path(__file__).parents[1]
PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    ROOT / "CHANGELOG.md",
    *sorted((ROOT / "docs").glob("*.md")),
    *sorted((ROOT / "msg_docs").glob("*.md")),
]
NOT_CODE = {p.name for p in PARAMETERS} | {key.path for key in KEYS} | {"ctr_dynamics/findings/1"}
SNAP_VALUES = {"tube_coulomb", "tube_viscous", "epsilon", "beta1"}  # what `snap --set` takes
TEXT = {
    page: page.read_text(encoding="utf-8") for page in [*PAGES, *sorted((ROOT / "examples").rglob("*.md"))]
}


@pytest.fixture(scope="module")
def commands():
    return dict(reference.commands())


def test_every_command_and_option_is_explained(commands):
    page = TEXT[ROOT / reference.PAGE]
    for name, command in commands.items():
        assert f"### ctr-dynamics {name}\n" in page
        assert command.help, name
        for option in command.params:
            if option.name != "help":
                assert getattr(option, "help", ""), f"{name}: {option.name} has no help"
                for flag in option.opts if option.param_type_name == "option" else []:
                    assert f"`{flag}`" in page, f"{name} {flag}"
    assert set(cli.available()) == {name.split()[0] for name in commands}


def test_every_parameter_is_documented():
    parameters, page = TEXT[ROOT / "docs" / "parameters.md"], TEXT[ROOT / reference.PAGE]
    for parameter in PARAMETERS:
        assert f"`{parameter.name}`" in parameters
        assert parameter.text
    for table in NODES.values():
        for parameter in table:
            assert parameter.text
            assert f"| `{parameter.name}` |" in page


def test_every_topic_and_field_is_documented():
    page = TEXT[ROOT / "docs" / "topics.md"]
    for topic in TOPICS:
        assert f"`{topic.name}`" in page
        assert (ROOT / "msg_docs" / topic.page).is_file()
        assert undocumented(topic) == []
    assert TUBES_TOPIC in TEXT[ROOT / "docs" / "view.md"]
    assert "/ctr/joint_commands" in TEXT[ROOT / "docs" / "controller.md"]


def test_every_service_of_the_node_is_documented():
    text = (ROOT / "ctr_dynamics" / "ros" / "estimator_node.py").read_text()
    offered = set(re.findall(r'create_service\(\w+, "~/(\w+)"', text))
    assert {name.rsplit("/", 1)[1] for name in reference.SERVICES} == offered


def test_every_public_argument_is_explained():
    missing = [line for name, thing in reference.public() for line in reference.unexplained(name, thing)]
    assert missing == []
    assert all(thing.__doc__ for _, thing in reference.public())


def test_the_glossary_holds_only_names_that_occur():
    used = {argument for _, thing in reference.public() for argument in reference.arguments(thing)}
    assert set(reference.GLOSSARY) - used == set()


@pytest.mark.parametrize("page", list(TEXT), ids=lambda page: page.name)
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)]+)\)", TEXT[page]):
        if target.startswith(("http://", "https://")):
            continue
        file, _, anchor = target.partition("#")
        there = (page.parent / file).resolve() if file else page
        assert there.exists(), f"{page.name}: {target}"
        if anchor:
            heads = re.findall(r"^#+ (.+)$", there.read_text(), re.MULTILINE)
            assert anchor in {
                re.sub(r"[^\w -]", "", head).strip().lower().replace(" ", "-") for head in heads
            }, target


@pytest.mark.parametrize("page", list(TEXT), ids=lambda page: page.name)
def test_commands_in_the_pages_exist(page, commands):
    """Every `ctr-dynamics NAME --option` that a page tells to type."""
    blocks = "\n".join(re.findall(r"```sh\n(.*?)```", TEXT[page], re.DOTALL)).replace("\\\n", " ")
    for line in re.findall(r"^ctr-dynamics (.+)$", blocks, re.MULTILINE):
        words = line.split("#")[0].split()
        name = next((n for n in (" ".join(words[:2]), words[0]) if n in commands), None)
        if name is None and words[0] in cli.COMMANDS:
            continue  # a command of a later version
        assert name is not None, line
        known = {flag for p in commands[name].params for flag in [*p.opts, *p.secondary_opts]}
        used = {word.split("=")[0] for word in re.sub(r'"[^"]*"', "X", line).split() if word.startswith("--")}
        assert used <= known, line
        for assignment in re.findall(r"--set (\w[\w.]*)=", line):
            assert assignment in (SNAP_VALUES if words[0] == "snap" else {p.name for p in PARAMETERS}), line


def definitions(module: Path) -> dict[str, ast.AST]:
    """Functions, classes and assigned names at the top of a module, by name."""
    found: dict[str, ast.AST] = {}
    for node in ast.parse(module.read_text(encoding="utf-8")).body:
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            found[node.name] = node
        elif isinstance(node, ast.Assign):
            found |= {target.id: node for target in node.targets if isinstance(target, ast.Name)}
        elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            found[node.target.id] = node
    return found


def missing_part(name: str) -> str:
    """The first part of a dotted name below `ctr_dynamics` that does not exist; empty when all do."""
    place, parts = ROOT / "ctr_dynamics", name.split(".")
    while parts and (place / parts[0]).is_dir():
        place /= parts.pop(0)
    module = place / f"{parts[0]}.py" if parts else place / "__init__.py"
    if not module.is_file() and parts:
        module = place / "__init__.py"
    elif parts:
        parts.pop(0)
    if not parts:
        return ""
    found = definitions(module).get(parts[0])
    if found is None:
        return parts[0]
    members = {n.name for n in getattr(found, "body", []) if isinstance(n, ast.FunctionDef)}
    return "" if len(parts) == 1 or parts[1] in members else parts[1]


@pytest.mark.parametrize(
    "page", [p for p in TEXT if p.name != reference.PAGE.name], ids=lambda page: page.name
)
def test_names_and_files_of_the_code_in_the_pages_exist(page):
    """Dotted names in code spans, with or without `ctr_dynamics` before them, and paths of files."""
    packages = {path.stem for path in (ROOT / "ctr_dynamics").glob("[a-z]*")}
    for span in re.findall(r"`([^`\n]+)`", TEXT[page]):
        name = span.split("(")[0].removeprefix("ctr_dynamics.")
        if re.fullmatch(r"[a-z_]+(\.\w+)+", name) and name.split(".")[0] in packages and name not in NOT_CODE:
            assert missing_part(name) == "", f"{page.name}: {span}"
        elif (
            re.fullmatch(r"(ctr_dynamics|tools|test|studies|examples)/[\w/.]+", span) and span not in NOT_CODE
        ):
            assert (ROOT / span).exists(), f"{page.name}: {span}"


def function_source(name: str) -> tuple[Path, str]:
    """File and source of a function, method or class by its dotted name below `ctr_dynamics`."""
    place, parts = ROOT / "ctr_dynamics", name.split(".")
    while (place / parts[0]).is_dir():
        place /= parts.pop(0)
    file = place / f"{parts.pop(0)}.py"
    text = file.read_text(encoding="utf-8")
    node: ast.AST = ast.parse(text)
    for part in parts:
        node = next(
            child
            for child in getattr(node, "body", [])
            if isinstance(child, (ast.FunctionDef, ast.ClassDef)) and child.name == part
        )
    return file, ast.get_source_segment(text, node) or ""


def calls(source: str, name: str) -> bool:
    """Whether the source of a function names the function or class of that dotted name."""
    *_, owner, last = name.split(".")
    return re.search(rf"\b{owner if last == '__init__' else last}\b", source) is not None


def walks() -> dict[str, list[tuple[str, str]]]:
    """Functions of each walk in docs/architecture.md, each with the attribute in which it stores its result."""
    page = TEXT[ROOT / "docs" / "architecture.md"]
    section = page.partition("## Three walks through the code")[2]
    found = {}
    for part in section.split("\n### ")[1:]:
        title, _, text = part.partition("\n")
        found[title] = re.findall(r"^\| `([\w.]+)` \|[^|]*\| (?:`(\w+)`)? ?\|$", text, re.MULTILINE)
    return found


@pytest.mark.parametrize("title", list(walks()))
def test_a_walk_leads_through_the_code(title):
    steps = walks()[title]
    assert len(steps) >= 4
    files = set()
    for i, (name, stored) in enumerate(steps):
        file, source = function_source(name)
        files.add(file)
        if i + 1 == len(steps):
            break
        after = steps[i + 1][0]
        _, next_source = function_source(after)
        if stored:
            assert re.search(rf"\b{stored}\b", source), f"{name} does not store `{stored}`"
            assert re.search(rf"\b{stored}\b", next_source), f"{after} does not take `{stored}`"
        else:
            assert calls(source, after) or calls(next_source, name), (
                f"neither calls the other: {name}, {after}"
            )
    assert len(files) <= 8, sorted(file.name for file in files)


def test_layers_are_those_that_are_checked():
    checked = (ROOT / "pyproject.toml").read_text().partition("layers = [")[2].partition("]")[0]
    shown = TEXT[ROOT / "docs" / "architecture.md"].partition("## Layers")[2].partition("## Data flow")[0]
    rows = re.findall(r"^\| [^|]*\| (`[^|]+) \|", shown, re.MULTILINE)
    assert [re.findall(r"`(\w+)`", row) for row in rows] == [
        re.findall(r"\w+", layer) for layer in re.findall(r'"([^"]+)"', checked)
    ]


def test_there_are_three_walks():
    assert len(walks()) == 3


def string_constants() -> str:
    """Every string of the package, f-strings with their fields as *."""
    texts = []
    for file in (ROOT / "ctr_dynamics").rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.JoinedStr):
                texts.append(
                    "".join(str(v.value) if isinstance(v, ast.Constant) else "*" for v in node.values)
                )
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                texts.append(node.value)
    return "\n".join(texts)


def test_messages_in_the_troubleshooting_page_are_ours():
    """Its headings quote what the program says; * stands for a number or name."""
    said = string_constants()
    page = TEXT[ROOT / "docs" / "troubleshooting.md"]
    quoted = re.findall(r"^### `(.+)`$", page, re.MULTILINE)
    assert len(quoted) > 15
    for text in quoted:
        parts = [part.strip() for part in text.split("*") if len(part.strip()) > 3]
        assert parts
        for part in parts:
            assert part in said, f"'{part}' of '{text}' is nowhere said"


def test_citation_is_a_citation_file():
    data = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert data["cff-version"] == "1.2.0"
    assert {"message", "title", "authors", "license", "version"} <= set(data)
    assert data["references"][0]["year"] == 2020


def test_index_leads_to_every_page():
    index = TEXT[ROOT / "docs" / "index.md"]
    assert "(docs/index.md)" in TEXT[ROOT / "README.md"]
    for page in (ROOT / "docs").glob("*.md"):
        assert f"({page.name})" in index or page.name == "index.md", page.name


@pytest.mark.slow
def test_the_lines_of_python_in_the_readme_run(tmp_path, monkeypatch, capsys):
    [code] = re.findall(r"```python\n(.*?)```", TEXT[ROOT / "README.md"], re.DOTALL)
    assert len(code.strip().splitlines()) <= 10
    (tmp_path / "ctr_dynamics").symlink_to(ROOT / "ctr_dynamics")
    monkeypatch.chdir(tmp_path)
    exec(compile(code, "README.md", "exec"), {})
    assert "2 tubes" in capsys.readouterr().out
    assert (tmp_path / "report.html").stat().st_size > 10_000
