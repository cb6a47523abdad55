"""A sharing dictionary is a dictionary, and its copies are their own."""

from hypothesis import given
from hypothesis import strategies as st

from semviz_annotation.labels.shared_dict import SharedDict

KEYS = st.integers(0, 600) | st.text(max_size=2)
STEPS = st.lists(st.tuples(KEYS, st.none() | st.integers()), max_size=60)


def follow(target: object, steps: list[tuple[str | int, int | None]]) -> None:
    for key, value in steps:
        if value is None:
            target.pop(key, None)
        else:
            target[key] = value


@given(STEPS, STEPS, STEPS)
def test_it_does_what_a_dict_does_and_copies_do_not_see_each_other(before, mine, theirs):
    plain = {}
    follow(plain, before)
    shared = SharedDict(plain)
    copy, plain_copy = SharedDict(shared), dict(plain)
    follow(shared, mine)
    follow(plain, mine)
    follow(copy, theirs)
    follow(plain_copy, theirs)
    assert (shared == plain, len(shared), set(shared)) == (True, len(plain), set(plain))
    assert (copy == plain_copy, len(copy), set(copy)) == (True, len(plain_copy), set(plain_copy))
    both = plain.keys() | plain_copy.keys()
    unlike = {key for key in both if plain.get(key) is not plain_copy.get(key)}
    assert shared.differing(copy) == copy.differing(shared) == unlike


def test_a_copy_of_many_shares_nearly_all():
    many = SharedDict({f"{key}": object() for key in range(10_000)})
    copy = SharedDict(many)
    copy["7"] = object()
    shared = [here is there for here, there in zip(many._shards, copy._shards, strict=True)]
    assert shared.count(False) == 1
    assert many.differing(copy) == {"7"}
