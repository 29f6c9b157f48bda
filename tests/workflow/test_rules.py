"""Rules and scripts must speak of the same names; every rule must have what the house asks of it."""

from __future__ import annotations

import re
from dataclasses import dataclass, field, fields
from importlib import import_module
from pathlib import Path

import pytest
import yaml

from cosp import sheets

HOME = Path(__file__).resolve().parents[2]
RULE_FILES = sorted((HOME / "rules").glob("*.smk"))
GIVEN_BY_SNAKEMAKE = {"get", "keys", "items", "values"}


@dataclass
class Rule:
    """What a rule gives to its script."""

    name: str
    text: str
    names: dict[str, set[str]] = field(default_factory=dict)

    @property
    def script_name(self) -> str:
        """Of the script that the rule runs; rules that do the same to other inputs may share one."""
        found = re.search(r"^    script:\n        \"\.\./scripts/(\w+)\.py\"", self.text, flags=re.M)
        assert found, f"rule {self.name} runs no script"
        return found[1]

    @property
    def script(self) -> str:
        return (HOME / "scripts" / f"{self.script_name}.py").read_text(encoding="utf-8")


def _keys(shared: str) -> set[str]:
    """Of a dictionary that several rules take their files from."""
    common = (HOME / "rules" / "common.smk").read_text(encoding="utf-8")
    found = re.search(rf"^{shared} = \{{\n(.*?)^\}}", common, flags=re.M | re.S)
    assert found, f"rules/common.smk defines no {shared}"
    return set(re.findall(r"^    \"(\w+)\":", found[1], flags=re.M))


def _rules() -> list[Rule]:
    rules = []
    for path in RULE_FILES:
        for block in re.split(r"^(?=rule |use rule )", path.read_text(encoding="utf-8"), flags=re.M)[1:]:
            if not block.startswith("rule "):
                continue  # it is another one with other files
            block = block.removeprefix("rule ")
            rule = Rule(name=block.split(":", 1)[0], text=block)
            for section in re.findall(r"^    (\w+):\n((?:^        .*\n|^\n)+)", block, flags=re.M):
                names = set(re.findall(r"^        (\w+)=", section[1], flags=re.M))
                for choices in re.findall(r'^        \*\*choices\("(\w+)"\)', section[1], flags=re.M):
                    names |= set(sheets.schema("config")["properties"][choices].get("properties", {}))
                for shared in re.findall(r"^        \*\*(\w+),", section[1], flags=re.M):
                    names |= _keys(shared)
                rule.names[section[0]] = names
            rules.append(rule)
    return rules


RULES = _rules()


def _asked(script: str, section: str) -> set[str]:
    """Names that a script takes from a section of its rule."""
    asked = set(re.findall(rf"snakemake\.{section}\.(\w+)", script)) - GIVEN_BY_SNAKEMAKE
    asked |= set(re.findall(rf"snakemake\.{section}\.get\(\s*[\"'](\w+)", script))
    # A dataclass may pick its fields among them.
    for name in re.findall(rf"(\w+)\.of\(snakemake\.{section}\)", script):
        module = re.search(rf"^from ([\w.]+) import .*\b{name}\b", script, flags=re.M)
        assert module
        asked |= {one.name for one in fields(getattr(import_module(module[1]), name))}
    return asked | set(re.findall(rf"snakemake\.{section}\[[\"'](\w+)", script))


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.name)
@pytest.mark.parametrize("section", ["input", "output", "params"])
def test_a_script_asks_for_what_its_rule_gives(rule: Rule, section: str) -> None:
    missing = _asked(rule.script, section) - rule.names.get(section, set())
    assert not missing, (
        f"scripts/{rule.script_name}.py asks for {section} that the rule does not give: {sorted(missing)}"
    )


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.name)
def test_every_choice_in_the_config_is_used_by_its_script(rule: Rule) -> None:
    chosen = sheets.schema("config")["properties"].get(rule.name, {}).get("properties", {})
    unused = set(chosen) - _asked(rule.script, "params")
    assert not unused, f"config keys of {rule.name} that its script never reads: {sorted(unused)}"


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.name)
def test_every_rule_says_what_the_house_asks(rule: Rule) -> None:
    for section in ("output", "log", "benchmark", "conda", "threads", "resources", "params", "message", "script"):
        assert re.search(rf"^    {section}:", rule.text, flags=re.M), f"rule {rule.name} has no {section}"
    assert f'script_digest("{rule.script_name}")' in rule.text
    assert {"mem_mb", "runtime"} <= rule.names["resources"]
    assert f"logs/{rule.name}/" in rule.text
    assert re.search(rf"benchmarks/{rule.name}/[^\"]*\.jsonl", rule.text)


def test_every_script_belongs_to_a_rule() -> None:
    assert {path.stem for path in (HOME / "scripts").glob("*.py")} == {rule.script_name for rule in RULES}


def test_scripts_do_not_hide_snakemakes_preamble() -> None:
    for path in (HOME / "scripts").glob("*.py"):
        source = path.read_text(encoding="utf-8")
        assert "from __future__" not in source, path.name
        assert not re.search(r"^from \.", source, flags=re.M), path.name


def test_every_environment_named_by_a_rule_exists_and_is_used() -> None:
    named = {name for rule in RULES for name in re.findall(r"envs/([\w-]+\.yaml)", rule.text)}
    assert "cosp.yaml" in named
    for name in named:
        assert yaml.safe_load((HOME / "envs" / name).read_text(encoding="utf-8"))["dependencies"]


def test_every_caption_named_by_a_rule_exists() -> None:
    for name in {name for rule in RULES for name in re.findall(r"captions/([\w-]+\.rst)", rule.text)}:
        assert (HOME / "docs" / "captions" / name).read_text(encoding="utf-8").strip()
