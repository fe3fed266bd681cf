import pytest

from kjax.runs.bisection import Bracket, bisect


@pytest.mark.parametrize(("easy", "hard"), [(0.0, 2.0), (1.0, 0.05)])
def test_the_limit_lies_in_a_bracket_no_wider_than_the_resolution(easy, hard):
    limit, asked = 0.3, []
    sign = 1.0 if hard > easy else -1.0

    def passes(value):
        asked.append(value)
        return sign * value <= sign * limit

    found = bisect(passes, easy, hard, 0.05)
    assert sign * found.passed <= sign * limit < sign * found.failed
    assert abs(found.failed - found.passed) <= 0.05 + 1e-9
    assert len(asked) == len(set(asked)) <= 8
    assert asked[0] == easy


def test_all_pass_and_none_pass():
    asked = []
    assert bisect(lambda v: bool(asked.append(v) or True), 0.0, 1.0, 0.1) == Bracket(1.0, None)
    assert asked == [0.0, 1.0]
    assert bisect(lambda v: False, 0.0, 1.0, 0.1) == Bracket(None, 0.0)


def test_a_resolution_that_never_ends_is_refused():
    with pytest.raises(ValueError, match="resolution"):
        bisect(lambda v: True, 0.0, 1.0, 0.0)
