"""The text of the repository has no phrases of the house dialect: plain, idiomatic technical English."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
#: {regular expression of whole words in lower case, in which a space is any white space: what to write instead}
PATTERNS = {
    r"(is|are|was|were|be|been) said": "states, reports, triggers a warning",
    r"(is|are|was|were) told (of|about|in|once)|what (is|was) told": "warns about, reports",
    r"(is|are) named(?=[,.])": "is listed, is called",
    r"(?<!there\s)(is|are|was|were) no (?!(longer|more|larger|smaller|better)\b)[a-z]+": "is not a, does not",
    r"strangers?": "untrusted",
    r"what [^.:,]{1,30} (is|are) like|(is|are) like an?": "similar to, seed-like",
    r"seldom(?![\":)\]]| =)": "rarely",
    r"(of|about|by|to) whom": "whose, or name the person",
    r"whose [^.:,]{1,40} (is|are) none|(file|number|value) that is none": "without a",
    r"(is|are|was|were) none of": "is not one of",
    r"that of (a|an|the) [^.:,]{1,60} that of": "name the thing again",
    r"go(es)? on": "continues, extends",
    r"knows? no|no [a-z]+ knows|has none of": "ignores, lacks",
    r"looked for": "searched for, found, detected",
    r"as (it lies|they lie)|anyhow": "in any orientation",
    r"of before|(the one|those) before": "previous, earlier",
    r"an? [a-z]+ of (its|their) own": "a separate",
    r"from which (on|that)": "least, above which",
    r"is not there": "is missing, does not exist",
    r"(?<!db\s)re (the|its|that|those|an?|one|what)": "relative to",
    r"(?<!now\s)as of (a|an|the|another)": "such as, as in, as from",
    r"(it|that|they|which|these|those) (is|are|was|were) of (a|an|the|another|this|that)": "belongs to, shows",
    r"any more|but for|for ever|on the mean": "no longer, except for, forever, on average",
    r"(stays?|left) as (it|they) (is|are|was|were)": "does not change",
    r"(?<!\.)taken for": "assumed to be, read as, counts as, mistaken for",
    r"what (lies|is (outside|inside|behind|beyond|below|around|between|bright|dark|left))": "name the thing: the rest",
    r"(is|are|was|were) (that|those) of": "agrees with, comes from; a pronoun makes readers search for its noun",
}
_ANY = "|".join(rf"\b(?P<n{n}>{pattern})\b" for n, pattern in enumerate(PATTERNS)).replace(" ", r"\s+")
_PARTS = (
    *("SlicerUSSim/**/*.py", "SlicerUSSim/**/*.js", "SlicerUSSim/**/*.html", "kernels/*.cl*", "docs/*.md", "*.md"),
    *("paper/*.md", "NOTICE", ".github/**/*.md", "examples/**/*.ipynb"),
    *(f"{folder}/**/*.py" for folder in ("validation", "benchmarks", "examples", "tests")),
)
#: This file, and what is generated from declarations
SKIPPED = re.compile(r"docs/parameters|test_words")


def test_the_text_has_no_phrases_of_the_house_dialect():
    found, instead = [], list(PATTERNS.values())
    for path in sorted(path for part in _PARTS for path in ROOT.glob(part)):
        name = path.relative_to(ROOT).as_posix()
        if not SKIPPED.search(name):
            # Lines of one sentence without the indents, comment signs and quotation marks between them
            text = re.sub(r'"?\n[ \t]*((#:?|//)[ \t]*|f?")?', "\n", path.read_text(encoding="utf-8").lower())
            for hit in re.finditer(_ANY, text):
                line, advice = text.count("\n", 0, hit.start()) + 1, instead[int(str(hit.lastgroup)[1:])]
                found.append(f"{name}:{line}: {' '.join(hit[0].split())!r}: write {advice!r}")
    assert not found, "\n".join(found)


def test_the_text_has_no_conflict_markers_of_a_merge():
    paths = [path for part in _PARTS for path in ROOT.glob(part)]
    markers = re.compile(r"^(<{7}|>{7}) ", re.MULTILINE)
    assert [path.name for path in paths if markers.search(path.read_text(encoding="utf-8"))] == []
