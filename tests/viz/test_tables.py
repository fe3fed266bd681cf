import pytest

from kjax.viz.tables import markdown_table


def test_a_table_is_markdown_with_as_many_rules_as_columns():
    text = markdown_table(("gait", "RMSE [m/s]"), [("trot", "0.01"), ("bound", "0.07")])
    assert text == ("| gait | RMSE [m/s] |\n|---|---|\n| trot | 0.01 |\n| bound | 0.07 |\n")
    assert markdown_table(["a"], []) == "| a |\n|---|\n"


def test_a_row_of_another_length_is_refused():
    with pytest.raises(ValueError, match=r"wanted 2 cells as in the header, got \('trot',\)"):
        markdown_table(("gait", "RMSE"), [("trot",)])
