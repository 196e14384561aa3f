"""Docstrings, messages, comments and documents use the field's words.

Each rule is a private word of this project's past and what to write instead. Where the word is also ordinary English, the pattern
names the private use only.
"""

import ast
import io
import re
import tokenize
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).resolve().parents[1]


class Rule(NamedTuple):
    """A pattern that must not occur, what to write instead, a sentence that it must find, and one that it must not."""

    pattern: str
    instead: str
    wrong: str
    right: str


RULES = [
    Rule(
        r"\bat[ _]rest\b|\brest[ _](image|frame|skin|level)s?\b|\b(level|skin|surface) of rest\b|poisson_?rest"
        r"|\b(above|below|knows?|means) rest\b",
        "undeformed (skin), background (image), without contact",
        "Skin at rest is zero.",
        "The rest of the image is ignored.",
    ),
    Rule(
        r"\b(\d+|six|twelve|few|fewer|many|more|extra|free) numbers\b|\|\s*numbers\s*\|"
        r"|\bnumbers (of (a|the) (model|fit|field|candidate)|a slope)\b",
        "parameters",
        "A field of 36 numbers.",
        "step: expected three numbers above 0",
    ),
    Rule(r"\btells?\b|\btold\b|\btelling\b", "report, say, know, show", "The image tells nothing.", "It says intelligible things."),
    Rule(
        r"``(seen|touched)``|\bseen (image|colours?|frame)s?\b|\btouched (pixel|area|skin|frame)s?\b",
        "compensated, contact",
        "Args: ``seen``: (B, 3, H, W).",
        "Nothing is touched?",
    ),
    Rule(
        r"\b(?<!degrees\s)(?<!elements\s)(?<!pixels\s)(?<!mm\s)(?<!far\s)(?<!them\s)apart\b|\btorn\b(?! (file|write)s?)",
        "residual, difference, has_shadow, separately",
        "How far both are apart.",
        "Lights 120 degrees apart.",
    ),
    Rule(
        r"\bdoubt(s|ed|ing)?\b|\bguess(es|ed|ing)? again\b|\blook(s|ed|ing)? beyond\b",
        "classify dark pixels, restart from lit neighbours, test the mirrored normal",
        "It doubts dark channels.",
        "A guess.",
    ),
    Rule(
        r"\bjudg(e|es|ed|ing|ement)\b",
        "integrability residual, residual integrator; score, decide",
        "It is judged.",
        "It is adjusted.",
    ),
    Rule(r"\brelight", "solve shadowed normals", "relight(images)", "The light."),
    Rule(
        r"\bfores(ee|ees|een|eeing|aw|ight)\b|\bforet(ells?|old|elling)\b|worth_px",
        "predicts change, refine_threshold_px",
        "What the pass foresees.",
        "It predicts.",
    ),
    Rule(
        r"\bunsound\b|\bsound (pixel|neighbour|frame|skin|channel|image|cell|one)s?\b",
        "valid, invalid",
        "expected sound pixels",
        "It sounds an alarm.",
    ),
    Rule(
        r"\bfull (channel|pixel|light)s?\b|\b(channels?|pixels?|colours?) (that )?(is|are|was|were) full\b|\bfull at\b",
        "saturated",
        "Channels that are full.",
        "The full image.",
    ),
    Rule(
        r"\bweak (matri(x|ces)|lights?|pixels?|solve)\b|\bill (matri(x|ces)|lights?|pixels?)\b|\b(is|are) ill\b(?!-)",
        "ill-conditioned",
        "Where the lights are ill.",
        "The matrix is ill-conditioned; a weak prior.",
    ),
    Rule(
        r"\bpin(s|ned|ning)?\b(?!-memory| (memory|packages|versions))|\bloose (direction|light|motion|center)s?\b",
        "constrains, well / poorly constrained; held by a test",
        "The image pins the lights.",
        "A pinhole camera.",
    ),
    Rule(
        r"\bdear(er|est|ly)?\b|\bheld by [\d.]+",
        "regularisation strength, strongly regularised",
        "Products, held by 60.",
        "Held by a test; 3 presses held out.",
    ),
    Rule(r"\bevened\b", "brightness-normalised", "An evened field.", "It happened evenly."),
    Rule(
        r"\blifted (field|response|family)|\blift(s|ed)? (a|the) (field|response)", "embedded", "A lifted field.", "It is lifted."
    ),
    Rule(r"\bheed(s|ed|ing)?\b", "use", "The prior heeds depth.", "It needs depth."),
    Rule(r"\bblank (model|field|response|one|prior)s?\b", "zero model", "A blank model.", "A blank line."),
    Rule(
        r"\b(same|another|other|its|their|by|under) readings?\b|\breadings? (of|under) (the )?(presses|candidates)\b|\bas_read\b",
        "preprocessing",
        "Presses of the same reading.",
        "Reading files; what you see on reading it.",
    ),
    Rule(r"\bskirt(s|ed)?\b", "transition zone", "The skirt of a contact.", "The zone."),
    Rule(r"\blean(s|ed|ing)?\b", "slope per shift", "How the rims lean.", "A clean edge."),
    Rule(r"\blamps?\b", "LED, failed LED", "A dead lamp.", "A light."),
    Rule(r"\bdial(s|led)?\b|\bharmless\b|\bhopeless\b", "corruption, severity", "Thirty dials.", "A dialogue."),
    Rule(
        r"\bcompiled loops?\b|\bby (tensor )?operators\b", "compiled kernels, PyTorch reference", "By compiled loops.", "Operators."
    ),
    Rule(r"\blevell(ed|ing)\b", "normalised (light), zeroed (depth)", "A levelled frame.", "The level."),
]  # fmt: skip
PIPELINE = Rule(r"\bmisfits?\b", "integrability residual", "The misfit.", "It fits.")
"""Holds where frames are solved: the fit of lights may have a misfit."""


def compiled(rule):
    """The rule's pattern, whose spaces match line breaks too."""
    return re.compile(rule.pattern.replace(" ", r"\s+"), re.IGNORECASE)


def spoken(source):
    """Strings, docstrings and comments of Python code: (first line, text)."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.lineno, node.value
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            yield token.start[0], token.string


def written(path):
    """The parts of a file that a person reads: (first line, text)."""
    source = path.read_text(encoding="utf-8")
    if path.suffix == ".py":
        yield from spoken(source)
        return
    if path.name == "CHANGELOG.md":
        source = re.sub(r"`[^`\n]*`", "``", source)  # where old names stand beside the new ones
    comment = {".c": r"/\*.*?\*/|//[^\n]*", ".h": r"/\*.*?\*/|//[^\n]*", ".yaml": r"#[^\n]*"}.get(path.suffix)
    for match in re.finditer(comment or r"\A.*\Z", source, re.DOTALL):
        yield source.count("\n", 0, match.start()) + 1, match.group()


def files():
    """What a person reads: the package, scripts, documents, sensor files."""
    for folder, suffixes in (("torchvts", (".py", ".c", ".h")), ("scripts", (".py",)), ("docs", (".md",)), ("configs", (".yaml",))):
        yield from sorted(path for path in (ROOT / folder).rglob("*") if path.suffix in suffixes)
    yield from (ROOT / name for name in ("README.md", "CHANGELOG.md", "CONTRIBUTING.md"))


def hits(path):
    """Private words in a file, one line of text each."""
    name = path.relative_to(ROOT).as_posix()
    rules = [*RULES, PIPELINE] if re.match(r"torchvts/pipeline/(?!expected_error)", name) else RULES
    patterns = [(compiled(rule), rule) for rule in rules]
    for first, text in sorted(set(written(path))):
        for pattern, rule in patterns:
            for match in pattern.finditer(text):
                before, after = text[: match.start()].rpartition("\n")[2], text[match.end() :].partition("\n")[0]
                line = " ".join(f"{before}{match.group()}{after}".split())
                yield f"{name}:{first + text.count(chr(10), 0, match.start())}: {match.group()!r}: write {rule.instead}: {line}"


def test_the_fields_words_are_used():
    found = [hit for path in files() for hit in hits(path)]
    assert not found, f"{len(found)} private words:\n" + "\n".join(found)


NAMES = re.compile(
    r"(^|_)(lamps?|dials?|relight|heeds?|skirts?|levelled|torn|told|tells?|foresees?|judged?|judges|dear|evened|lifted|blank)(_|$)"
    r"|(^|_)(at_rest|rest_image|worth_px)(_|$)",
    re.IGNORECASE,
)


def test_identifiers_are_the_fields_words():
    found = set()
    for path in files():
        if path.suffix == ".py":
            name = path.relative_to(ROOT).as_posix()
            tokens = tokenize.generate_tokens(io.StringIO(path.read_text(encoding="utf-8")).readline)
            found |= {f"{name}: {token.string}" for token in tokens if token.type == tokenize.NAME and NAMES.search(token.string)}
    assert not found, "\n".join(sorted(found))


def test_files_are_named_by_the_fields_words():
    named = re.compile(r"(^|_)(rest|relight|dials?|lamps?|told|judge|skirt|loops|cliffs?|lean|figures_dict)(_|\.|$)")
    places = [path for folder in ("torchvts", "scripts", "docs", "configs") for path in (ROOT / folder).rglob("*")]
    found = [path.relative_to(ROOT).as_posix() for path in places if named.search(path.name) and "__pycache__" not in path.parts]
    assert not found


@pytest.mark.parametrize("rule", [*RULES, PIPELINE], ids=lambda rule: rule.instead)
def test_a_rule_finds_the_private_use_only(rule):
    pattern = compiled(rule)
    assert pattern.search(rule.wrong) and pattern.search(rule.wrong.replace(" ", "\n"))
    assert not pattern.search(rule.right)


def test_strings_docstrings_and_comments_are_read():
    source = 'def f(x):\n    """One."""\n    y = f"two {x} three"  # four\n    return y\n'
    assert sorted(text for _, text in spoken(source)) == [" three", "# four", "One.", "two "]
