from gnd.words import many


def test_one_is_one_and_all_else_are_many() -> None:
    assert [many(n, "tile") for n in (0, 1, 2)] == ["0 tiles", "1 tile", "2 tiles"]
    assert [many(n, "reply", "replies") for n in (1, 3)] == ["1 reply", "3 replies"]
