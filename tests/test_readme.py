"""README's code runs as it stands."""

import re
from pathlib import Path

import pytest

README = Path(__file__).resolve().parents[1] / "README.md"


@pytest.mark.filterwarnings("ignore::torchvts.CalibrationWarning")
def test_code_of_readme_runs_in_order():
    blocks = re.findall(r"```python\n(.*?)```", README.read_text(), re.DOTALL)
    assert len(blocks) == 2
    names: dict[str, object] = {}
    for block in blocks:
        exec(block, names)
    assert float(names["out"].depth_mm.max()) == pytest.approx(1.0, abs=0.02)


def test_readme_names_only_files_that_exist():
    for path in re.findall(r"\]\(([^)#:]+)\)", README.read_text()) + re.findall(r"scripts/\w+\.py", README.read_text()):
        assert (README.parent / path).exists(), path
