"""Pseudonyms: names for a day each, alike for all, and of nobody for who lacks the authority's key."""

import datetime as dt
import json
import os
import shutil
from pathlib import Path

import pytest
from click.testing import CliRunner
from hypothesis import given
from hypothesis import strategies as st

from gnd.deploy.certs_cli import certs
from gnd.fleet_bus.errors import IdentityError
from gnd.fleet_bus.identity.authority import REGISTER, Authority
from gnd.fleet_bus.identity.folder import load_identity, problems
from gnd.fleet_bus.identity.lists import MemberList
from gnd.fleet_bus.identity.names import IDENTITY_VARIABLE, MemberName
from gnd.fleet_bus.identity.pseudonyms import (
    MAX_COUNT,
    Period,
    is_folder_of_pseudonyms,
    issue_pseudonyms,
    present_pseudonym,
    pseudonyms_of,
    take_pseudonym,
    whose,
)

NOW = dt.datetime(2026, 11, 23, 15, 0, tzinfo=dt.UTC)


@pytest.fixture
def authority(tmp_path: Path) -> Authority:
    return Authority.create(tmp_path / "authority", "tests")


@given(
    st.datetimes(dt.datetime(2021, 1, 1), dt.datetime(2060, 1, 1)).map(lambda t: t.replace(tzinfo=dt.UTC)),
    st.floats(0.1, 700.0),
)
def test_a_period_holds_its_time_and_the_next_begins_where_it_ends(now: dt.datetime, hours: float) -> None:
    period = Period.at(now, hours)
    assert period.begins <= now < period.next.begins
    assert abs((period.next.begins - period.begins).total_seconds() - 3600 * hours) <= 0.5
    assert period.next == Period.at(period.next.begins, hours)
    assert period.last_second == period.next.next.begins


def test_all_vehicles_change_their_names_at_the_same_times(authority: Authority, tmp_path: Path) -> None:
    first = issue_pseudonyms(authority, "car-1", tmp_path / "1", count=3)
    second = issue_pseudonyms(authority, "car-2", tmp_path / "2", count=3)
    assert [(one.begins, one.ends) for one in first] == [(one.begins, one.ends) for one in second]
    assert len({one.name for one in first + second}) == 6
    assert all(dt.datetime.fromisoformat(one.begins).minute == 55 for one in first), "five minutes before midnight"


def test_certificates_differ_in_names_keys_and_numbers_alone(authority: Authority, tmp_path: Path) -> None:
    """Whatever else differed between two vehicles would tell their certificates of other days apart."""
    issue_pseudonyms(authority, "a", tmp_path / "1", count=1)
    issue_pseudonyms(authority, "a-vehicle-with-a-rather-long-name", tmp_path / "2", count=1)
    one, two = (load_identity(next((tmp_path / name).iterdir())).certificate for name in ("1", "2"))
    assert [(e.oid, e.critical, e.value) for e in one.extensions] == [
        (e.oid, e.critical, e.value) for e in two.extensions
    ]
    assert (one.not_valid_before_utc, one.not_valid_after_utc) == (two.not_valid_before_utc, two.not_valid_after_utc)
    assert [a.rfc4514_attribute_name for a in one.subject] == [a.rfc4514_attribute_name for a in two.subject]
    assert len(one.subject.rfc4514_string()) == len(two.subject.rfc4514_string())


def test_nothing_that_others_hold_says_whose_a_pseudonym_is(authority: Authority, tmp_path: Path) -> None:
    issue_pseudonyms(authority, "car-with-a-name", tmp_path / "p", count=4)
    files = [path for path in tmp_path.rglob("*") if path.is_file()]
    assert len(files) > 12
    assert not [path for path in files if b"car-with-a-name" in path.read_bytes()]
    lines = (authority.folder / REGISTER).read_text().splitlines()
    sealed = [json.loads(line)["holder"] for line in lines]
    assert len(set(sealed)) == 4, "the same holder reads differently each time"
    assert len({len(one) for one in sealed}) == 1


def test_the_authority_knows_and_another_key_does_not(authority: Authority, tmp_path: Path) -> None:
    (entry,) = issue_pseudonyms(authority, "car-7", tmp_path / "p", count=1)
    again = Authority(authority.folder)
    assert whose(again, entry.name) == "car-7"
    assert [one.name for one in pseudonyms_of(again, "car-7")] == [entry.name]
    assert pseudonyms_of(again, "car-8") == []
    other = Authority.create(tmp_path / "other", "others")
    shutil.copy(authority.folder / REGISTER, other.folder / REGISTER)
    with pytest.raises(IdentityError, match="another key"):
        whose(Authority(other.folder), entry.name)


def test_who_is_no_pseudonym_is_said_to_be_none(authority: Authority, tmp_path: Path) -> None:
    authority.issue(MemberName("vehicle", "v-1"), tmp_path / "v")
    with pytest.raises(IdentityError, match="own name"):
        whose(authority, "v-1")
    with pytest.raises(IdentityError, match="knows no such vehicle"):
        whose(authority, "p22222222222")


def test_what_is_there_stays_and_later_periods_are_added(authority: Authority, tmp_path: Path) -> None:
    folder = tmp_path / "p"
    first = issue_pseudonyms(authority, "car-1", folder, count=2)
    assert issue_pseudonyms(authority, "car-1", folder, count=2) == []
    more = issue_pseudonyms(authority, "car-1", folder, count=5)
    assert len(more) == 3
    assert {one.name for one in more}.isdisjoint(one.name for one in first)


@pytest.mark.parametrize("count", [0, MAX_COUNT + 1])
def test_counts_and_lengths_out_of_bounds_are_refused(authority: Authority, tmp_path: Path, count: int) -> None:
    with pytest.raises(IdentityError, match=f"{count} pseudonyms"):
        issue_pseudonyms(authority, "car-1", tmp_path / "p", count=count)
    for hours in (0.0, -1.0, 1e6, float("nan")):
        with pytest.raises(IdentityError, match="a minute to 31 days"):
            issue_pseudonyms(authority, "car-1", tmp_path / "p", hours=hours)
    with pytest.raises(IdentityError, match="must be 1 to 55"):
        issue_pseudonyms(authority, "no such name", tmp_path / "p")
    assert not (tmp_path / "p").exists()


def test_the_present_one_is_the_one_whose_period_has_begun_last(authority: Authority, tmp_path: Path) -> None:
    folder = tmp_path / "p"
    issue_pseudonyms(authority, "car-1", folder, count=3)
    begins = sorted(path.name for path in folder.iterdir())
    assert is_folder_of_pseudonyms(folder)
    assert not is_folder_of_pseudonyms(folder / begins[0])
    today = Period.at(dt.datetime.now(dt.UTC), 24.0)
    for day, name in enumerate(begins):
        begun = today.begins + dt.timedelta(days=day)
        assert present_pseudonym(folder, begun).name == name
        assert present_pseudonym(folder, begun + dt.timedelta(hours=23, minutes=59)).name == name
    assert problems(load_identity(folder / begins[0])) == []
    assert "not yet valid" in problems(load_identity(folder / begins[1]))[0]
    last_day = today.begins + dt.timedelta(days=3, hours=23)  # nobody has issued more: the last holds a day longer
    assert present_pseudonym(folder, last_day).name == begins[2]
    with pytest.raises(IdentityError, match=r"has ended .* `gnd certs pseudonyms`"):
        present_pseudonym(folder, last_day + dt.timedelta(hours=2))
    with pytest.raises(IdentityError, match="is it wrong"):
        present_pseudonym(folder, today.begins - dt.timedelta(seconds=1))


def test_a_process_keeps_the_name_that_it_has_taken(
    authority: Authority, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (entry, *_) = issue_pseudonyms(authority, "car-1", tmp_path / "p")
    monkeypatch.setenv(IDENTITY_VARIABLE, str(tmp_path / "p"))
    assert take_pseudonym() == (entry.name, tmp_path / "p")
    assert load_identity(Path(os.environ[IDENTITY_VARIABLE])).name == entry.name
    assert take_pseudonym() is None, "a plain identity stays as it is"
    monkeypatch.delenv(IDENTITY_VARIABLE)
    assert take_pseudonym() is None


def test_a_vehicle_is_revoked_with_all_its_pseudonyms(authority: Authority, tmp_path: Path) -> None:
    where = ("--authority", str(authority.folder))
    run = CliRunner()
    said = run.invoke(certs, ["pseudonyms", "car-1", *where, "--out", str(tmp_path / "p"), "--count", "3"]).output
    assert said.startswith(f"3 of 3 pseudonyms of car-1 are new in {tmp_path / 'p'}, the last until ")
    run.invoke(certs, ["pseudonyms", "car-2", *where, "--out", str(tmp_path / "q"), "--count", "1"])
    names = json.loads(run.invoke(certs, ["whose", "--all", "car-1", "--json", *where]).output)
    assert set(names.values()) == {"car-1"}
    assert len(names) == 3
    one = next(iter(names))
    assert run.invoke(certs, ["whose", one, *where]).output == f"{one}  car-1\n"
    taken = run.invoke(certs, ["revoke", "vehicle.car-1", *where])
    assert taken.exit_code == 0
    assert all(f"vehicle.{name}: certificate" in taken.output for name in names)
    listed = MemberList.decode((authority.folder / "members.json").read_bytes(), (authority.certificate,))
    assert listed.revoked == {f"vehicle.{name}" for name in names}
    assert len(listed.members) == 1, "the other vehicle"
    again = run.invoke(certs, ["revoke", "vehicle.car-1", *where])
    assert "has no certificate that holds" in str(again.exception)
