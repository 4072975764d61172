"""The option `--effects`, the decisions by evidence, and the cost of an effect that is off."""

from __future__ import annotations

import dataclasses
from collections import Counter

import pytest
import torch

from neilfpp_method.cli import main
from neilfpp_method.data.pixels.dataset import PixelDataset
from neilfpp_method.effects.evidence.disagreement import RenderedSurface, shading_disagreement
from neilfpp_method.effects.evidence.material import EFFECTS_AT_PLACES
from neilfpp_method.effects.evidence.visibility import self_visibility
from neilfpp_method.effects.measurement import Measurement, mean_of
from neilfpp_method.effects.plan import Plan, stored_decision
from neilfpp_method.effects.request import check_effects, parse_effects
from neilfpp_method.effects.review import _rendered_surface, record_lamps, review_surface
from neilfpp_method.errors import UserError
from neilfpp_method.fields import environment
from neilfpp_method.fields.direction_map import interpolate
from neilfpp_method.lighting import fit, solve
from neilfpp_method.lighting.fit import Evidence, fit_light
from neilfpp_method.schedule import Stage, active_losses
from neilfpp_method.settings.plain import changed
from neilfpp_method.settings.presets import preset
from neilfpp_method.shading import LOBES, Lobe
from neilfpp_method.structures import SceneLight
from tests.scenes import sphere_batch, sphere_model, tiny_config
from tests.test_model import count_queries
from tests.train.small_runs import solved_light


def half_walls(share: float):
    """A scene in which the cosine-weighted share `share` of all directions, those nearest to the normal z,
    hits a wall.
    """

    def scene_light(x, wi):
        # For cosine-weighted directions cos² θ is uniform, so this share has cos² θ > 1 − share.
        hit = wi[..., 2].square() > 1 - share
        return SceneLight(hit, torch.zeros_like(wi), torch.where(hit, 1.0, torch.inf))

    return scene_light


class OnePicture(PixelDataset):
    """Training pixels that all show the ball."""

    def __init__(self):
        pass

    def sample(self, count, gradients=True):
        return sphere_batch(400)


@pytest.mark.parametrize("share", [0.0, 0.25, 1.0])
def test_self_visibility_is_the_cosine_weighted_share(share):
    model = sphere_model(solved_light(tiny_config()))
    model.host.scene_light = half_walls(share)
    up = torch.tensor([[0.0, 0.0, 1.0]]).expand(400, 3)
    found = self_visibility(model, model.config, up, up)
    assert found.value == pytest.approx(share, abs=0.01)
    assert found.favours(chosen=False) is (share > 0)


def test_a_ball_does_not_occlude_itself_so_nothing_is_traced():
    config = solved_light(tiny_config())
    config = dataclasses.replace(config, shading=dataclasses.replace(config.shading, hit_share=0.2))
    named = "auto," + ",".join(f"+{name}" for name in (*EFFECTS_AT_PLACES, "joint-stage"))
    model, plan = sphere_model(config), Plan.begin(parse_effects(named), config)
    torch.manual_seed(0)
    (decision,) = review_surface(plan, model, OnePicture(), step=4)
    assert not decision.on
    assert decision.evidence.samples > 100

    def traced():
        return count_queries(model, lambda: model.losses(sphere_batch(), Stage.MATERIAL_INIT))

    calls = []
    original = model.host.scene_light
    model.host.scene_light = lambda x, wi: calls.append(wi.shape) or original(x, wi)
    traced()
    assert calls
    calls.clear()
    model.use(plan.config)
    counts = traced()
    assert not calls
    assert counts["rays"] == len(sphere_batch())


def counted(lobe: Lobe, calls: Counter) -> Lobe:
    """The same lobe; its calls are counted."""

    def count(name):
        def call(*arguments):
            calls[name] += 1
            return getattr(lobe, name)(*arguments)

        return call

    return Lobe(*(count(field.name) for field in dataclasses.fields(lobe)))


def asked_of_the_lobe(effects: str, monkeypatch) -> Counter:
    config = Plan.begin(parse_effects(effects), solved_light(tiny_config())).config
    calls = Counter()
    monkeypatch.setitem(LOBES, config.shading.lobe, counted(LOBES[config.shading.lobe], calls))
    model = sphere_model(
        dataclasses.replace(config, shading=dataclasses.replace(config.shading, hit_share=0.2))
    )
    calls.clear()
    model.losses(sphere_batch(), Stage.MATERIAL_INIT)
    return calls


def test_a_lobe_that_is_off_is_not_evaluated(monkeypatch):
    assert asked_of_the_lobe("all", monkeypatch)["sample_cos_h"] > 0
    without_sampling = asked_of_the_lobe("all,-lobe-sampling", monkeypatch)
    assert without_sampling["distribution"] > 0
    assert without_sampling["sample_cos_h"] == without_sampling["pdf_h"] == 0
    assert not asked_of_the_lobe("all,-reflection", monkeypatch)


def test_an_even_light_has_no_look_ups_and_one_source(monkeypatch):
    config = Plan.begin(parse_effects("all,-environment-map"), solved_light(tiny_config())).config
    model = sphere_model(
        dataclasses.replace(config, shading=dataclasses.replace(config.shading, hit_share=0.2))
    )
    looked_up, sources = [], []
    monkeypatch.setattr(environment, "interpolate", lambda *a: looked_up.append(a) or interpolate(*a))
    monkeypatch.setattr(fit, "fit_light", lambda *a: sources.append(a[1].sources.shape[2]) or fit_light(*a))
    solver = model.light_solver()
    while not solver.due:
        solver.observe(model.step(sphere_batch(), Stage.MATERIAL_INIT))
    before = model.light.log_radiance.clone()
    solver.solve(model.brdf, model.scene)
    assert not looked_up
    assert sources[0] == 1 + solve.CANDIDATES  # of the map, one
    assert model.light.log_radiance.flatten(1).std(1).max() < 1e-6
    assert (model.light.log_radiance != before).all()


def test_white_light_has_one_channel():
    # Without lamps: they could explain the brighter side as well.
    config = Plan.begin(parse_effects("all,-coloured-light,-lamps"), solved_light(tiny_config())).config
    fit = dataclasses.replace(config.light.fit, points=200)
    config = dataclasses.replace(
        config,
        light=dataclasses.replace(config.light, fit=fit),
        shading=dataclasses.replace(config.shading, hit_share=0.2),
    )
    model = sphere_model(config)
    solver, batch = model.light_solver(), sphere_batch(400)
    # One side is ten times as bright, so that the texels of the map must differ.
    batch = dataclasses.replace(batch, color=batch.color * (1 + 9 * (batch.directions[:, :1] > 0)))
    while not solver.due:
        solver.observe(model.step(batch, Stage.MATERIAL_INIT))
    solver.solve(model.brdf, model.scene)
    channels = model.light.log_radiance
    assert channels.flatten(1).std(1).max() > 0.01
    torch.testing.assert_close(channels, channels[:1].expand_as(channels))


def test_without_reflection_all_effects_that_need_it_are_off():
    plan = Plan.begin(parse_effects("auto,-reflection"), preset("fast"))
    config = plan.config
    assert not config.shading.specular
    assert not config.brdf.metals
    assert not config.brdf.varying_roughness
    assert config.shading.sampler == "no_lobe"
    assert not plan.is_open("metals")


def test_advice_is_reported_and_changes_nothing():
    plan = Plan.begin(parse_effects("auto"), preset("fast"))
    worthless = Measurement("error", 0.0, 0.001, 0.01, 100)
    assert worthless.favours(True) is False
    for name in ("reflection", "environment-map", "coloured-light", "varying-roughness"):
        decision = plan.decide(name, worthless, 4)
        assert decision.on
        assert "advice" in decision.reason
    assert plan.config == plan.settings
    assert not plan.decide("lobe-sampling", worthless, 4).on
    assert plan.config.shading.sampler == "no_lobe"


def test_without_varying_material_no_gradient_is_computed():
    config = Plan.begin(parse_effects("as-set,-metals,-varying-roughness"), tiny_config()).config
    config = dataclasses.replace(config, loss=dataclasses.replace(config.loss, smoothness=1.0))
    assert "smoothness" not in active_losses(Stage.MATERIAL_INIT, config)
    assert "smoothness" in active_losses(Stage.MATERIAL_INIT, changed(config, {"brdf.metals": True}))


def test_shading_as_accurate_as_r_needs_no_joint_stage():
    model = sphere_model(tiny_config()).eval()
    seen = _rendered_surface(model, sphere_batch(400))
    observed, radiance = seen.observed, seen.radiance
    assert len(radiance) > 50
    material = model.materials(observed.position)
    samples = model.config.shading.eval_samples
    shaded = model.shade(observed.position, observed.normal, observed.wo, material, samples).color.detach()
    same = RenderedSurface(dataclasses.replace(observed, pixel=shaded), shaded)
    assert shading_disagreement(model, same).value == 0
    worse = shading_disagreement(
        model, RenderedSurface(dataclasses.replace(observed, pixel=radiance), radiance)
    )
    off = (shaded - radiance).abs() / (radiance + 0.1 * model.units.physical)
    assert worse.value == pytest.approx(off.clamp_max(1).mean().item(), rel=1e-4)


def test_decisions_are_revised_and_reported():
    config = preset("fast")
    plan = Plan.begin(parse_effects("auto"), config)
    few = Measurement("directions", 0.2, 0.01, 0.01, 400)
    assert plan.decide("inter-reflection", few, 4).on
    gone = plan.decide("inter-reflection", Measurement("directions", 0.001, 0.0005, 0.01, 400), 8)
    assert not gone.on
    assert gone.reason.startswith("revised: ")
    assert plan.config.light.inter_reflection == "off"
    assert plan.config_of_model == config
    unknown = plan.decide("inter-reflection", Measurement("directions", 0.5, 0.1, 0.01, 3), 9)
    assert not unknown.on
    assert "only 3 samples" in unknown.reason


def test_a_decision_on_lamps_is_recorded_when_it_changes():
    plan = Plan.begin(parse_effects("auto"), preset("fast"))
    assert record_lamps(plan, Evidence(0.001, 0.002, 200), 0, 5)[0].on is False
    assert record_lamps(plan, Evidence(0.001, 0.002, 200), 0, 9) == []
    (found,) = record_lamps(plan, Evidence(0.1, 0.002, 200), 2, 14)
    assert found.on
    assert found.reason.startswith("revised")
    assert plan.config.light.kind == "auto"  # the solver continues to decide
    assert (
        record_lamps(Plan.begin(parse_effects("-lamps"), preset("fast")), Evidence(0.1, 0.0, 200), 1, 5) == []
    )


def test_the_standard_error_is_that_of_the_mean():
    found = mean_of(torch.tensor([0.0, 1.0, 2.0, 3.0]), "x", 0.1)
    assert (found.value, found.deviation) == pytest.approx((1.5, (5 / 3) ** 0.5 / 2))
    assert found.favours(True) is None  # four samples are too few


def test_names_switch_settings():
    config = preset("fast")
    none = Plan.begin(parse_effects("none"), config).config
    assert (none.shading.specular, none.light.environment_height, none.light.monochrome) == (False, 1, True)
    assert (none.brdf.metals, none.brdf.varying_roughness, none.train.joint_steps) == (False, False, 0)
    assert (none.light.inter_reflection, none.light.kind, none.background.kind) == (
        "off",
        "distant",
        "constant",
    )
    everything = Plan.begin(parse_effects("all,-lamps"), config).config
    assert (everything.light.inter_reflection, everything.light.kind) == ("hard", "distant")
    assert Plan.begin(parse_effects("as-set"), config).config == config
    free = tiny_config()
    assert (
        Plan.begin(parse_effects("as-set"), free).config
        == Plan.begin(parse_effects("auto"), free).config
        == free
    )
    assert Plan.begin(parse_effects("none,+inter-reflection"), none).config.light.inter_reflection == "hard"


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("lamps", r"'lamps' has no sign; write \+lamps or -lamps"),
        ("auto,-lamp", "no effect 'lamp'; did you mean 'lamps'"),
        ("some", "'some' is not a choice; give auto"),
        ("", "the value is empty"),
        ("+lamps,-lamps", "lamps is named twice"),
        ("-response", "--response"),
        ("none,+metals", r"metals requires reflection; add \+reflection"),
    ],
)
def test_bad_names_get_one_line(text, complaint):
    with pytest.raises(UserError, match=complaint):
        check_effects(parse_effects(text), preset("fast"))


def test_a_free_light_has_no_lamps_to_switch():
    with pytest.raises(UserError, match="free at every point"):
        check_effects(parse_effects("+lamps"), tiny_config())


def test_a_bad_name_ends_the_command(tmp_path, capsys):
    assert main(["train", "--data", str(tmp_path), "--effects", "auto,-lamp"]) == 2
    assert "did you mean 'lamps'" in capsys.readouterr().err


@pytest.mark.parametrize(("value", "on"), [(0.001, True), (0.0004, False), (-0.0001, False)])
def test_metals_have_to_be_earned(value, on):
    plan = Plan.begin(parse_effects("auto"), preset("fast"))
    gain = Measurement("error", value, 0.0003, 0.0, 400)
    assert plan.decide("metals", gain, 5).on is on
    assert plan.decide("long-tails", gain, 5).on, "it stays on unless it is significantly worse"


@pytest.mark.parametrize("evidence", [True, 3, [], {}, {"what": "gain"}])
def test_evidence_of_another_form_is_refused_in_one_line(evidence):
    plan = Plan.begin(parse_effects("auto"), preset("fast"))
    decision = plan.decide("metals", Measurement("gain", 1.0, 0.1, 0.0, 100), 0)
    with pytest.raises(UserError, match=r"run/effects\.json: not a complete record"):
        stored_decision({**dataclasses.asdict(decision), "evidence": evidence}, "run/effects.json")
