from pathlib import Path

import pytest

from gnd.deploy.errors import RunFolderError
from gnd.deploy.run_folder import create_run_folder


def test_a_new_folder_has_its_parts(tmp_path: Path) -> None:
    folder = create_run_folder(tmp_path / "a" / "b")
    assert all(path.is_dir() for path in (folder.logs, folder.world, folder.agents, folder.ledger))


def test_an_earlier_run_is_replaced_only_on_demand(tmp_path: Path) -> None:
    folder = create_run_folder(tmp_path / "run")
    folder.write_mark({"config": {}})
    folder.summary.write_text("{}")
    with pytest.raises(RunFolderError, match="--overwrite"):
        create_run_folder(tmp_path / "run")
    create_run_folder(tmp_path / "run", overwrite=True)
    assert not folder.summary.exists()


def test_what_is_no_run_is_never_removed(tmp_path: Path) -> None:
    (tmp_path / "precious.txt").write_text("keep me")
    with pytest.raises(RunFolderError, match="holds no run"):
        create_run_folder(tmp_path, overwrite=True)
    assert (tmp_path / "precious.txt").exists()


def test_a_folder_that_cannot_be_made_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(RunFolderError):
        create_run_folder(tmp_path / "file")
    with pytest.raises(RunFolderError, match="choose another folder"):
        create_run_folder(tmp_path / "file" / "below")
