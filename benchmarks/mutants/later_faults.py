"""Faults of patches, tilts, light fits, relighting, files, health and attached hosts."""

from __future__ import annotations

from collections.abc import Sequence

from benchmarks.mutants.mutant import Mutant

__all__ = ["LATER_FAULTS"]

TRACER, SCATTERING = "relight/path_tracer.py", "relight/scattering.py"
LATER_FAULTS: Sequence[Mutant] = (
    Mutant(
        "a hit is moved away from the surface before patches are compared",
        "hosts/patches.py",
        "start[near] - step",
        "start[near] + step",
        "hosts/test_patches.py",
    ),
    Mutant(
        "patches are compared with their brightness",
        "hosts/patches.py",
        "own - own.mean(-1, keepdim=True), other - other.mean(-1, keepdim=True)",
        "own, other",
        "hosts/test_patches.py",
    ),
    Mutant(
        "tilts of normals get no gradient of the image",
        "model.py",
        "tilted(smooth, self.tilts(position))",
        "tilted(smooth, self.tilts(position).detach())",
        "fields/test_normal_tilts.py",
    ),
    Mutant(
        "a point with a huge gradient determines how normals are tilted",
        "fields/normal_tilts.py",
        "MAX_GRADIENT * length.median()",
        "length.max()",
        "fields/test_normal_tilts.py",
    ),
    Mutant(
        "the gradient of a light fit contains the rows of one thread",
        "kernels/products.py",
        "sums.sum(0).t()",
        "sums[0].t()",
        "kernels/test_products.py",
    ),
    Mutant(
        "a direction of the BRDF has the weight of light sampling",
        TRACER,
        "power_heuristic(pdf, scene.sky.pdf(wi))",
        "power_heuristic(scene.sky.pdf(wi), pdf)",
        "relight/test_path_tracer.py",
    ),
    Mutant(
        "shadow rays to the lamps of the path tracer are ignored",
        TRACER,
        "~scene.surface.blocked(origins[rows], wi, sample.distance[rows])",
        "torch.ones_like(pdf)",
        "relight/test_path_tracer.py",
    ),
    Mutant(
        "density of the path tracer without the share of the cosine",
        SCATTERING,
        "(1 - at.share) * pdf_cosine(",
        "pdf_cosine(",
        "relight/test_scattering.py",
    ),
    Mutant(
        "the path tracer forgets the cosine",
        SCATTERING,
        "[:, 0] * cosine * above",
        "[:, 0] * above",
        "relight/test_scattering.py",
    ),
    Mutant(
        "density of the map of the path tracer without solid angles",
        "relight/sky.py",
        "self._mass.sum() / self._solid_angles[:, None])",
        "self._mass.sum())",
        "relight/test_sky.py",
    ),
    Mutant(
        "a movie without all of its frames is accepted",
        "relight/movie.py",
        "if written != len(pictures):",
        "if False:",
        "relight/test_movie_on_full_disk.py",
    ),
    Mutant(
        "an EXR file without its last rows is accepted",
        "data/files/images.py",
        "if not has_all_chunks(temporary):",
        "if False:",
        "data/files/test_exr_chunks.py",
    ),
    Mutant(
        "checkpoints of other versions are accepted",
        "train/checkpoint.py",
        'contents.get("format") != FORMAT or ',
        "",
        "train/test_checkpoint_version.py",
    ),
    Mutant(
        "steps of an attached host that are not finite are taken",
        "health/guard.py",
        "if not self._is_finite:",
        "if False:",
        "health/test_guard.py",
    ),
    Mutant(
        "skipped steps need not be consecutive to end a training",
        "health/guard.py",
        "            self._in_a_row = 0\n            return True",
        "            return True",
        "health/test_guard.py",
    ),
    Mutant(
        "a finding remains when it is no longer found",
        "health/watch.py",
        "self.findings.pop(case.name) for",
        "self.findings[case.name] for",
        "health/test_watch.py",
    ),
    Mutant(
        "steps without surface points are not counted",
        "health/watch.py",
        "else self.empty_steps + 1",
        "else 0",
        "health/test_watch.py",
    ),
    Mutant(
        "the optimizer of an attached host is not watched",
        "attach.py",
        "self.step_guard.watch(optimizer)",
        "pass",
        "test_attach_health.py",
    ),
    # The entering density.
    Mutant(
        "rays that leave matter become opaque, too",
        "volume/density.py",
        "torch.relu(-_antiderivative_differences(scaled))",
        "_antiderivative_differences(scaled).abs()",
        "volume/test_density.py",
    ),
    Mutant(
        "matter in front of a camera is invisible",
        "volume/density.py",
        "torch.cat([depth_at(sdf[..., :1], beta) + depth[..., :1]",
        "torch.cat([depth[..., :1]",
        "volume/test_density.py",
    ),
    Mutant(
        "the rendered cut is the most distant one",
        "volume/entering_samples.py",
        "partition.sdf.argmin(",
        "partition.sdf.argmax(",
        "volume/test_entering_samples.py",
    ),
    Mutant(
        "an interval with both ends outside cannot contain a thin object",
        "volume/entering_samples.py",
        "torch.minimum(nearest, deepest)",
        "nearest",
        "volume/test_entering_samples.py",
    ),
    Mutant(
        "the slope of the field is at most 1 wherever rays skip space",
        "volume/empty_space.py",
        "MARGIN * largest.clamp_min(1.0)",
        "MARGIN * torch.ones_like(largest)",
        "volume/test_empty_space.py",
    ),
    Mutant(
        "hits are the mean of the samples, inside the surface",
        "volume/hits.py",
        "depth = mean + inside",
        "depth = mean + 0.0 * inside",
        "volume/test_hits.py",
    ),
    Mutant(
        "hits of rays past an edge lie between the two surfaces",
        "volume/hits.py",
        "weights = weights * near_median(distances, intervals.weights, HIT_RADIUS)",
        "weights = weights * near_median(distances, intervals.weights, 9.0)",
        "hosts/test_volsdf.py",
    ),
    Mutant(
        "the automatic density acts at entry although geometry starts as a ball",
        "hosts/volsdf.py",
        'return "entering" if self.starts_from_shape else "isotropic"',
        'return "entering"',
        "hosts/test_volsdf.py",
    ),
    Mutant(
        "hits of the isotropic density lie at its zero set",
        "volume/hits.py",
        'if kind == "isotropic":',
        "if False:",
        "hosts/test_volsdf.py",
    ),
    # L_phys from two estimates.
    Mutant(
        "the absolute error of an estimate has its own sign",
        "losses.py",
        "first * second.detach().sign() + second * first.detach().sign()",
        "first * first.detach().sign() + second * second.detach().sign()",
        "test_losses.py",
    ),
    Mutant(
        "both estimates of the shading have the same directions",
        "model.py",
        "halves = [self._incident(position, normal, wo, material, count) for _ in range(parts)]",
        "halves = [self._incident(position, normal, wo, material, count)] * parts",
        "test_model.py",
    ),
)
