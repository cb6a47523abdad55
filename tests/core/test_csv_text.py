import csv
import io

import pytest

from semviz_core.common.files import cell_text, csv_text

FORMULAS = ("=1+2", "+1", "-1", "@a", "\t=1", " =1", "'=1", "''=1", "\n=1")
PLAIN = ("plain", "", "'", "it's", "a=b")


@pytest.mark.parametrize("text", [*FORMULAS, *PLAIN])
def test_no_text_is_a_formula_and_each_is_read_back(text: str) -> None:
    ((cell, number),) = csv.reader(io.StringIO(csv_text([[text, -1.5]]), newline=""))
    assert not cell.lstrip().startswith(("=", "+", "-", "@"))
    assert cell_text(cell) == text
    assert number == "-1.5"
    assert (cell == text) == (text in PLAIN)
