"""What a wrong file is answered: the key as it stands in the file, the value, and what is allowed."""

import pytest

from chargetune.battery.studies.campaign_file import CampaignFile
from chargetune.battery.studies.file_errors import keys_of
from chargetune.battery.studies.study_file import Config, load_config, read_tables


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[controller]\nhorizn = 5", "controller.horizn is not a known key; did you mean horizon?"),
        ("horizon = 5", "horizon is not a known key; horizon belongs in [controller]"),
        ("[limits]\nsoc_target = 0.8", "limits.soc_target is not a known key; soc_target belongs in [episode]"),
        ("[limits]\nsoc_targt = 0.8", "limits.soc_targt is not a known key; did you mean soc_target in [episode]?"),
        ("[controler]\nhorizon = 5", "controler is not a known key; did you mean controller?"),
        ("[theta.backof]\nnodes = 5", "theta.backof is not a known key; did you mean backoff?"),
        ("[theta.backoff]\nnode = 5", "theta.backoff.node is not a known key; did you mean nodes?"),
        ("[estimator.kalman]\nxyzzy = 5", "estimator.kalman.xyzzy is not a known key; known in [estimator.kalman] are "),
        ("[[study.earlier]]\nstore = 'a'\nstudi = 'b'", "study.earlier[0].studi is not a known key; did you mean study?"),
        (
            "[estimator.offset_free]\nresistance_rate = 2.0",
            "estimator.offset_free.resistance_rate = 2.0 is no key any more; resistance_drift replaced it",
        ),
        (
            "[estimator]\nkind = 'offset_free'\n[[theta.observer]]\nname = 'resistance_rate'\nlower = 0.5\nupper = 5.0",
            "theta.observer names 'resistance_rate', which is no number of the estimator any more; resistance_drift replaced it",
        ),
        ("[estimator]\noffset_free = 3", "estimator.offset_free = 3, allowed is a table [estimator.offset_free] with "),
        ("[controller]\nhorizon = 5.5", "controller.horizon = 5.5, allowed is a whole number"),
        ("[controller]\nsampling_time_s = true", "controller.sampling_time_s = true, allowed is a number"),
        ("[study]\nname = 3", "study.name = 3, allowed is text in quotes"),
        ("[study]\ntrials = 0", "study.trials = 0, allowed is at least 1"),
        ("[study]\nearlier = 3", "study.earlier = 3, allowed is tables [[study.earlier]] with store, study"),
        ("[theta]\nbackoff = 3", "theta.backoff = 3, allowed is a table [theta.backoff] with nodes, "),
        ('[plant]\nmodel = "dfn"', "plant.model = 'dfn', allowed is 'SPM', 'SPMe' or 'DFN' (did you mean 'DFN'?)"),
        ('[plant]\nmodel = "P2D"', "plant.model = 'P2D', allowed is 'SPM', 'SPMe' or 'DFN'"),
        ('[estimator]\nkind = "kalmann"', "(did you mean 'kalman'?)"),
        ('[study]\nname = "a/b"', "study name = 'a/b', allowed are 1 to 100 letters"),
        (f'[study]\nname = "{"n" * 101}"', "(101 characters), allowed are 1 to 100 letters"),
        ("[theta.R1]\nlower = 7.0", "lower = 7.0, allowed is [0.001, 0.999] below 1, the untuned ratio"),
        ('[campaign]\nconfigs = ["a.toml"]', "a campaign file, which `chargetune campaign` takes"),
        ("capacity_Ah = 3.0", "a cell file; a study names it in its table [cell], file = ..."),
    ],
)
def test_a_study_file(tmp_path, text, said):
    path = tmp_path / "s.toml"
    path.write_text(text)
    with pytest.raises(ValueError, match=r"s\.toml: ") as refused:
        load_config(path)
    assert said in str(refused.value)
    assert "{" not in str(refused.value)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[study]\ntrials = 3", "a study file, which `chargetune tune` takes"),
        ("[controller]\nhorizon = 3", "campaign is not given, and is needed: a table [campaign] with configs, seeds"),
        ("[campaign]\nconfig = ['a.toml']", "campaign.config is not a known key; did you mean configs?"),
        ("[campaign]\nconfigs = []", "campaign.configs"),
        ("[campaign]\nconfigs = ['a']\nseeds = 3.5", "campaign.seeds = 3.5, allowed is text in quotes or a list [...]"),
        ("[campaign]\nconfigs = ['a']\nseeds = [0, true]", "campaign.seeds[1] = true, allowed is a whole number"),
    ],
)
def test_a_campaign_file(tmp_path, text, said):
    path = tmp_path / "c.toml"
    path.write_text(text)
    with pytest.raises(ValueError, match=r"c\.toml: ") as refused:
        read_tables(path, CampaignFile)
    assert said in str(refused.value)
    assert "{" not in str(refused.value)


def test_every_key_of_the_settings_is_known():
    keys = keys_of(Config)
    assert keys[""] == list(Config.model_fields)
    assert {"horizon", "sampling_time_s"} <= set(keys["controller"])
    assert "lower" in keys["theta.R0"]
    assert "store" in keys["study.earlier"]
