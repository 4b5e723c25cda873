"""No parameter that nobody turns: what there is, is a documented setting, or varied somewhere."""

from pathlib import Path

from parameter_inventory import inventory

# 117, worlds (0137), identity (0150), rights, routers (0151), releases, privacy (two each), speeds, archives, together;
# the cloud's own switches for what several met and for copies (0166)
MOST = 132
"""There were 547 before docs/decisions/0122-settings.md; more than now need a reason."""
OF_A_SESSION = {"BusConfig"}


def test_parameters_are_few_and_each_is_turned_by_somebody() -> None:
    found = [one for one in inventory(Path(__file__).parents[2]) if not one.is_group]
    assert len(found) > 100  # else nothing was read
    assert len(found) <= MOST
    idle = {f"{one.owner}.{one.name}" for one in found if not one.is_setting and not one.given}
    idle -= {name for name in idle if name.split(".")[0] in OF_A_SESSION}
    assert not idle, idle


def test_what_is_varied_in_a_call_is_seen(tmp_path: Path) -> None:
    (tmp_path / "deploy").mkdir()
    (tmp_path / "studies").mkdir()
    (tmp_path / "deploy" / "one.py").write_text(
        "@dataclass\nclass A_Config:\n    x: int = 1\n    y: float = setting(2.0, 'e')\n    z: int = 3\n    must: str\n"
    )
    (tmp_path / "studies" / "two.py").write_text("A_Config(x=2)\nreplace(a, z=4)\n")
    found = {one.name: one for one in inventory(tmp_path)}
    assert sorted(found) == ["x", "y", "z"]
    assert (found["x"].given, found["y"].is_setting, bool(found["y"].given)) == ({"studies/two.py"}, True, False)
    assert found["z"].given == {"studies/two.py"}
