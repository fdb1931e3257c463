"""Diagnostics: every code that is made has its texts, every text can be filled, the page of codes is whole."""

import ast
import json
import string
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

import wepose_pin
from docs.diagnostics_page import document, list_examples
from wepose_pin import Diagnostic
from wepose_pin.diagnostics import ERROR, WARNING, as_json, from_json, join_text, render, render_all

PACKAGE = Path(wepose_pin.__file__).parent
# Functions that make a diagnostic of the code that is their first argument, beside `Diagnostic` itself.
CONSTRUCTORS = {"Diagnostic"}
PARTS = ("title", "what", "why", "do")  # of the text of a code
GROUPS = tomllib.loads((PACKAGE / "diagnostics.toml").read_text(encoding="utf-8"))
CATALOGUE = {code: table for codes in GROUPS.values() for code, table in codes.items()}
EXAMPLES = list_examples()


def calls() -> Iterator[tuple[str, ast.Call]]:
    """Every call in the package that makes a diagnostic, with its place."""
    for path in sorted(PACKAGE.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in CONSTRUCTORS:
                yield f"{path.relative_to(PACKAGE)}:{node.lineno}", node


def emitted() -> set[str]:
    """Codes that the package makes: a first argument as it stands, or strings of its module where it is a name."""
    codes = set()
    for place, call in calls():
        if place.startswith("diagnostics.py") and not isinstance(call.args[0], ast.Constant):
            continue
        code = call.args[0]
        if isinstance(code, ast.Constant):
            assert code.value in CATALOGUE, f"{place}: {code.value} is not in the catalogue"
            codes.add(code.value)
        else:
            source = ast.parse((PACKAGE / place.rpartition(":")[0]).read_text(encoding="utf-8"))
            named = {node.value for node in ast.walk(source) if isinstance(node, ast.Constant)} & set(CATALOGUE)
            assert named, f"{place}: the code is no string, and no string of the module is one"
            codes |= named
    return codes


def test_every_code_is_in_the_catalogue_and_every_entry_is_made() -> None:
    made = emitted()
    assert made - set(CATALOGUE) == set()
    assert set(CATALOGUE) - made == set(), "in the catalogue, and nothing makes it"


def test_facts_of_each_call_are_those_of_its_text() -> None:
    """Where the facts stand in the call itself."""
    seen = 0
    for place, call in calls():
        facts = next((word.value for word in call.keywords if word.arg == "facts"), None)
        facts = call.args[5] if len(call.args) > 5 else facts
        code = call.args[0]
        if not isinstance(code, ast.Constant) or not isinstance(facts, ast.Dict):
            continue
        keys = {key.value for key in facts.keys if isinstance(key, ast.Constant)}
        if len(keys) == len(facts.keys):
            seen += 1
            known = {name for (other, _), example in EXAMPLES.items() if other == code.value for name in example.facts}
            assert keys <= known | {"variant"}, f"{place}: the catalogue's example has no {keys - known}"
    assert seen


@pytest.mark.parametrize(("code", "variant"), EXAMPLES)
def test_every_text_is_filled_by_its_example_and_needs_all_of_it(code: str, variant: str) -> None:
    example = EXAMPLES[code, variant]
    text = render(example)
    title, *sentences = text.values()
    assert title
    for part in sentences:
        assert part.endswith((".", "!")), part
        assert "  " not in part
        assert "{" not in part.replace("{ up", "")
    assert join_text(text).startswith(text["what"])
    table = CATALOGUE[code]
    variants = table.get("variants", {})
    tables = [table, *variants.values()]
    parts = [each[part] for each in tables for part in PARTS if part in each]
    fields = {name for part in parts for _, name, _, _ in string.Formatter().parse(part) if name}
    whole = {**table, **variants.get(variant, {})}
    replaced = [whole[part] for part in PARTS]
    own = {name for part in replaced for _, name, _, _ in string.Formatter().parse(part)}
    assert all(getattr(example, name) not in ("", None) for name in own & {"place", "value", "limit"})
    facts = set(example.facts) - {"variant"}
    assert facts <= fields, f"the texts do not use {facts - fields}"


def test_tables_of_the_catalogue_have_nothing_else() -> None:
    codes = [code for tables in GROUPS.values() for code in tables]
    assert len(codes) == len(set(codes)), "a code stands in two groups"
    for tables in GROUPS.values():
        for code, table in tables.items():
            assert set(table) - {"variants", "follows"} == {*PARTS, "example"}, code
            assert set(table.get("follows", ())) <= set(codes), code
            for variant in table.get("variants", {}).values():
                assert set(variant) <= {*PARTS, "example"}, code


def test_the_page_of_codes_is_up_to_date() -> None:
    page = PACKAGE.parent / "docs" / "diagnostics.md"
    assert page.read_text(encoding="utf-8") == document(), "python docs/diagnostics_page.py"


def test_a_code_or_a_fact_that_is_not_there_fails() -> None:
    with pytest.raises(KeyError, match="no-such-code"):
        render(Diagnostic("no-such-code", WARNING))
    with pytest.raises(KeyError, match="method"):
        render(Diagnostic("static-phase-missing", WARNING))


def test_json_holds_data_and_text_and_comes_back() -> None:
    facts = {"variant": "sideways"}
    diagnostic = Diagnostic("hinge-implausible", ERROR, "left_elbow", 2.967, float("nan"), facts)
    content = json.loads(json.dumps(as_json(diagnostic), allow_nan=False))
    assert content["text"]["what"].startswith(
        "The segment below leaves the plane in which the left elbow bends by up to 170°"
    )
    assert content["limit"] is None
    assert from_json(content) == Diagnostic("hinge-implausible", ERROR, "left_elbow", 2.967, None, facts)
    content["text"] = {"title": "another"}
    assert from_json(content).code == "hinge-implausible"


def test_alike_are_told_together_the_gravest_first() -> None:
    lost = [
        Diagnostic("samples-lost", WARNING, name, 0.02 + 0.01 * k, 0.01, {"variant": "short", "longest": 0.02})
        for k, name in enumerate("abcde")
    ]
    dead = Diagnostic("sensor-frozen", WARNING, "e", facts={"variant": "orientation", "rows": 900})
    slow = Diagnostic("start-pose-late", "info", value=12.0)
    resets = Diagnostic("heading-resets-not-repeated", "info", "live.mcap", 2)
    texts = render_all([resets, *lost, lost[0], dead, slow])
    titles = [text["title"] for _, text in texts]
    assert titles[:2] == ["Samples lost", "Sensor frozen"]
    assert titles[2] == "Live heading resets not repeated"
    assert texts[0][0] == WARNING
    assert texts[0][1]["what"].count("lost") == 3
    assert texts[0][1]["what"].endswith("The same holds for d, e.")
    assert join_text(texts[0][1], titled=True).startswith("**Samples lost.** The a sensor lost 2 % of its samples")
