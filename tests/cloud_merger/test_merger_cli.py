import pytest
from click.testing import CliRunner

from gnd.cloud_merger.cli import merger
from gnd.cloud_merger.config import ShardConfig
from gnd.cloud_merger.merge import MergeParameters
from gnd.fleet_bus.settings_file import load_settings
from gnd.gnd_map.config import to_mapping
from gnd.gnd_map.errors import ConfigError, GndError


def read_config(path, options):
    return load_settings(ShardConfig, "merger", path, (), options, {})


def test_options_go_before_the_file(tmp_path):
    path = tmp_path / "merger.toml"
    path.write_text(
        'shard_id = "from-file"\nlease_s = 7\n'
        "[merge]\nxi = 0.7\n[ingest]\nreach_tiles = 1\n[store]\nmerge_delay_s = 0.5\n"
    )
    config = read_config(path, {"shard_id": "from-option", "merge": {"mode": "paper"}})
    assert (config.shard_id, config.lease_s, config.ingest.reach_tiles) == ("from-option", 7.0, 1)
    assert config.merge == MergeParameters(mode="paper", xi=0.7)
    assert config.store.merge_delay_s == 0.5


def test_defaults_run_and_survive_being_written_down():
    assert read_config(None, {}) == ShardConfig()
    assert ShardConfig.from_mapping(to_mapping(ShardConfig())) == ShardConfig()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("lease = 3", r"there is no setting lease; did you mean .*lease_s"),
        ("[merge]\nepsilon = 0.5", "there is no setting merge.epsilon"),
        ("[merge]\nmode = 'best'", "'paper'"),
        ("[merge]\nxi = 1.5", r"xi = 1\.5 lies outside ≥ 0 and < 1"),
        ("poll_s = 0", "poll_s"),
        ("lease_s = 0", "lease_s"),
        ("shard_id = 'a/b'", "shard id 'a/b'"),
        ("lease_s = ", "no valid TOML"),
    ],
)
def test_a_bad_configuration_is_one_clear_error(tmp_path, text, message):
    path = tmp_path / "merger.toml"
    path.write_text(text)
    with pytest.raises(GndError, match=message):
        read_config(path, {})


def test_a_missing_configuration_is_an_error(tmp_path):
    with pytest.raises(ConfigError, match=r"absent\.toml"):
        read_config(tmp_path / "absent.toml", {})


def test_the_command_passes_errors_on_to_the_root(tmp_path):
    path = tmp_path / "merger.toml"
    path.write_text("nonsense = 1")
    result = CliRunner().invoke(merger, ["--config", str(path)])
    assert isinstance(result.exception, ConfigError)
    assert "--store" in CliRunner().invoke(merger, ["--help"]).output
