"""The faults: each changes one place in one module."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

__all__ = ["MUTANTS", "Mutant"]


@dataclass(frozen=True)
class Mutant:
    """A fault in a module of the package.

    Attributes:
        what: the fault in a few words.
        module: path of the module below the package.
        old: the code that the fault replaces; it occurs exactly once in the module.
        new: the code with the fault.
        tests: path below `tests` of the tests that should notice it.
    """

    what: str
    module: str
    old: str
    new: str
    tests: str


BRDF, SAMPLING = "shading/brdf.py", "shading/sampling.py"
MUTANTS: Sequence[Mutant] = (
    # Shading.
    Mutant(
        "diffuse part without 1/π",
        "shading/rendering_equation.py",
        " / math.pi * _integrate(",
        " * _integrate(",
        "shading/test_rendering_equation.py",
    ),
    Mutant(
        "light from below the horizon is added",
        "shading/rendering_equation.py",
        "dot(incident.wi, n).clamp_min(0) * incident.weight",
        "dot(incident.wi, n) * incident.weight",
        "shading/test_rendering_equation.py",
    ),
    Mutant("Fresnel's power is 4", BRDF, "(1 - cos.d).pow(5)", "(1 - cos.d).pow(4)", "shading/test_brdf.py"),
    Mutant(
        "the part without Fresnel is not reduced by the Fresnel part",
        BRDF,
        "SpecularTerms(reflected - grazing, grazing)",
        "SpecularTerms(reflected, grazing)",
        "shading/test_brdf.py",
    ),
    Mutant(
        "metals reflect diffusely",
        BRDF,
        "base_color * (1 - material.metallic) if specular",
        "base_color if specular",
        "shading/test_brdf.py",
    ),
    Mutant(
        "α is r, not r²",
        BRDF,
        "wide.clamp_min(roughness_floor(wide.dtype)).square()",
        "wide.clamp_min(roughness_floor(wide.dtype))",
        "shading/test_brdf.py",
    ),
    Mutant(
        "the roughness of a lobe has no lower bound",
        BRDF,
        "wide.clamp_min(roughness_floor(wide.dtype)).square()",
        "wide.square()",
        "hard_cases/test_shading.py",
    ),
    Mutant(
        "GGX without correlation of masking",
        BRDF,
        "0.5 / (cos_o * masking(cos_i) + cos_i * masking(cos_o))",
        "0.5 / (cos_o * masking(cos_o) + cos_i * masking(cos_i))",
        "shading/test_brdf.py",
    ),
    Mutant(
        "the half vector points away from the light",
        BRDF,
        "((1 + dot(wi, wo)) / 2)",
        "((1 - dot(wi, wo)) / 2)",
        "shading/test_brdf.py",
    ),
    Mutant(
        "the cosine between `wo` and the half vector can be 0",
        BRDF,
        ".clamp(1e-8, 1).sqrt()",
        ".clamp(0, 1).sqrt()",
        "hard_cases/test_shading.py",
    ),
    Mutant(
        "sRGB's power is 1/2.2",
        "shading/color.py",
        ".pow(1 / 2.4) - 0.055",
        ".pow(1 / 2.2) - 0.055",
        "shading/test_color.py",
    ),
    Mutant(
        "the local frame is left-handed",
        "shading/frame.py",
        "torch.stack((tangent, bitangent, n), -2)",
        "torch.stack((bitangent, tangent, n), -2)",
        "shading/test_frame.py",
    ),
    Mutant(
        "a normal of length 0 divides by 0",
        "shading/frame.py",
        "torch.where(long_enough, squared, 1.0).sqrt()",
        "squared.sqrt()",
        "shading/test_frame.py",
    ),
    # Sampling.
    Mutant(
        "pdf of the lobe without the Jacobian of the half vector",
        SAMPLING,
        "/ (4 * cos.d)",
        "/ 4",
        "shading/test_sampling.py",
    ),
    Mutant(
        "pdf of the cosine sampler with 1/(2π)",
        SAMPLING,
        "dot(wi, n).clamp_min(0) / math.pi",
        "dot(wi, n).clamp_min(0) / (2 * math.pi)",
        "shading/test_sampling.py",
    ),
    Mutant(
        "the cosine sampler draws uniformly",
        SAMPLING,
        "_hemisphere(n, lambda u: (1 - u).sqrt(), pdf_cosine)",
        "_hemisphere(n, lambda u: 1 - u, pdf_cosine)",
        "shading/test_sampling.py",
    ),
    Mutant(
        "pdfs are combined without their shares",
        SAMPLING,
        "technique.pdf(wi) * (count / wi.shape[1])",
        "technique.pdf(wi)",
        "shading/test_sampling.py",
    ),
    Mutant(
        "stratified samples are always midpoints",
        "stratified/intervals.py",
        "(k + (torch.rand_like(k) if stochastic else 0.5)) / count",
        "(k + 0.5) / count",
        "shading/test_sampling.py",
    ),
    # Density and compositing.
    Mutant(
        "the signed distance has the wrong sign",
        "volume/density.py",
        "sdf.to(torch.promote_types(sdf.dtype, torch.float32)) / beta\n    # Ψ",
        "-sdf.to(torch.promote_types(sdf.dtype, torch.float32)) / beta\n    # Ψ",
        "volume/test_density.py",
    ),
    Mutant(
        "equal distances at both ends of an interval divide by 0",
        "volume/density.py",
        "torch.where(close, torch.ones_like(step), step)",
        "step",
        "volume/test_density.py",
    ),
    Mutant(
        "β has no lower bound",
        "volume/density.py",
        "self.above_floor.abs() + self.beta_floor",
        "self.above_floor.abs()",
        "volume/test_density.py",
    ),
    Mutant(
        "the transmittance of a sample includes its own density",
        "volume/compositing.py",
        "torch.exp(-depth_before[:, :-1])",
        "torch.exp(-depth_before[:, 1:])",
        "volume/test_compositing.py",
    ),
    Mutant(
        "the weight of a sample is its optical depth",
        "volume/compositing.py",
        "* -torch.expm1(-depth)\n",
        "* depth\n",
        "volume/test_compositing.py",
    ),
    Mutant(
        "samples in the wrong order have a weight",
        "volume/compositing.py",
        "dim=-1).diff(dim=-1).clamp_min(0.0)",
        "dim=-1).diff(dim=-1)",
        "volume/test_compositing.py",
    ),
    Mutant(
        "a distance of many β is NaN in half precision",
        "volume/density.py",
        "sdf.to(torch.promote_types(sdf.dtype, torch.float32)) / beta\n    # Ψ",
        "sdf / beta\n    # Ψ",
        "hard_cases/test_properties.py",
    ),
    # Losses.
    Mutant(
        "mask loss: object and background swapped",
        "losses.py",
        "object_mask * on_object + (1 - object_mask) * off_object",
        "object_mask * off_object + (1 - object_mask) * on_object",
        "test_losses.py",
    ),
    Mutant(
        "L_Eik asks for gradients of length 0",
        "losses.py",
        "(_safe_norm(gradient) - 1.0).abs()",
        "_safe_norm(gradient).abs()",
        "test_losses.py",
    ),
    Mutant(
        "the gradient of a length is not finite at 0",
        "losses.py",
        ".clamp_min(1e-12).sqrt()",
        ".sqrt()",
        "test_losses.py",
    ),
    Mutant(
        "L_smth is stronger at edges of the image",
        "losses.py",
        "torch.exp(-image_gradient)",
        "torch.exp(image_gradient)",
        "test_losses.py",
    ),
    Mutant(
        "L_pcd asks for the opposite normal",
        "losses.py",
        "distance.abs() + (1.0 - cosine)",
        "distance.abs() + (1.0 + cosine)",
        "test_losses.py",
    ),
    Mutant(
        "scaling a gradient also scales the value",
        "losses.py",
        "value.detach() * (1.0 - scale)",
        "value.detach() * scale",
        "test_losses.py",
    ),
    # Light.
    Mutant(
        "the rows of the map are counted from the bottom",
        "fields/direction_map.py",
        "((edge - 0.5).clamp(0, height - 1)",
        "((height - edge - 0.5).clamp(0, height - 1)",
        "fields/test_environment.py",
    ),
    Mutant(
        "pdf of the map without solid angles",
        "fields/map_sampling.py",
        "(share / cells.solid_angle)[texel]",
        "share[texel]",
        "fields/test_map_sampling.py",
    ),
    Mutant(
        "the map is sampled without the cosine",
        "fields/map_sampling.py",
        "power * cosine.clamp_min(0)",
        "power * torch.ones_like(cosine)",
        "fields/test_map_sampling.py",
    ),
    Mutant(
        "lamps fall off with the distance, not with its square",
        "fields/lamps.py",
        "math.pi * radius**2 / distance.square(), emission",
        "math.pi * radius**2 / distance, emission",
        "fields/test_lamps.py",
    ),
    Mutant(
        "panels also emit backwards",
        "fields/lamps.py",
        "(-(wi * axis).sum(-1)).clamp_min(0)",
        "(wi * axis).sum(-1).abs()",
        "fields/test_lamps.py",
    ),
    Mutant(
        "shadow rays to lamps are ignored",
        "incident/arriving.py",
        "radiance * visibility[..., None]",
        "radiance * 1.0",
        "incident/test_arriving.py",
    ),
    Mutant(
        "the light is also added where the scene blocks it",
        "incident/arriving.py",
        "torch.nonzero(~scene.hit, as_tuple=True)",
        "torch.nonzero(scene.hit | ~scene.hit, as_tuple=True)",
        "incident/test_arriving.py",
    ),
    # Readers.
    Mutant(
        "the camera's centre has the wrong sign",
        "data/cameras/camera.py",
        "-rotation @ self.w2c[:3, 3:]",
        "rotation @ self.w2c[:3, 3:]",
        "data/test_capture.py",
    ),
    Mutant(
        "the scene frame is not shifted to the centre",
        "data/views.py",
        "(points - points.new_tensor(self.center)) / self.scale",
        "points / self.scale",
        "data/test_capture.py",
    ),
    Mutant(
        "paths may leave the capture",
        "data/files/paths.py",
        "if path.resolve().is_relative_to(root.resolve()):",
        "if True:",
        "hard_cases/test_captures.py",
    ),
    Mutant(
        "mirrored cameras are accepted",
        "data/cameras/camera.py",
        "if np.linalg.det(rotation) < 0:",
        "if np.linalg.det(rotation) < -2:",
        "hard_cases/test_captures.py",
    ),
    Mutant(
        "cameras whose rays overflow float32 are accepted",
        "data/cameras/camera.py",
        "if min(camera.fx, camera.fy) < MIN_FOCAL or",
        "if False and",
        "hard_cases/test_captures.py",
    ),
    Mutant(
        "sizes in headers are not checked",
        "data/files/images.py",
        "width * height <= MAX_PIXELS",
        "True",
        "data/files/test_images.py",
    ),
    Mutant(
        "red and blue are swapped",
        "data/files/image_parts.py",
        "return samples[..., [2, 1, 0, 3][: samples.shape[2]]]",
        "return samples",
        "data/files/test_images.py",
    ),
    Mutant(
        "points that are not finite are accepted",
        "data/point_cloud.py",
        "~(np.isfinite(position) & np.isfinite(normal)).all(axis=1)",
        "~np.isfinite(position).any(axis=1)",
        "data/test_point_cloud.py",
    ),
    # Checkpoints.
    Mutant(
        "checkpoints may run code",
        "train/tensor_file.py",
        'map_location="cpu", weights_only=True)',
        'map_location="cpu", weights_only=False)',
        "train/test_tensor_file.py",
    ),
    Mutant(
        "checkpoints are written in place",
        "train/checkpoint.py",
        'with replacing(path) as temporary, temporary.open("wb") as file:',
        'with path.open("wb") as file:',
        "train/test_checkpoint.py",
    ),
    Mutant(
        "the optimizer starts anew on resume",
        "train/loop.py",
        '    optimizer.load_state_dict(saved["optimizer"])\n',
        "",
        "train/test_resume.py",
    ),
    Mutant(
        "all steps use the same random numbers",
        "train/optimizer.py",
        "(seed * 1_000_003 + step) * 4_099 + rank",
        "seed * 4_099 + rank",
        "train/test_resume.py",
    ),
    Mutant(
        "steps that are not finite are not skipped",
        "train/loop.py",
        "if all(math.isfinite(value) for value in (loss, *mean_norms)):",
        "if True:",
        "train/test_not_finite.py",
    ),
    Mutant(
        "evaluation in a training skips the empty space of an earlier geometry",
        "hosts/volsdf.py",
        "self._evaluation_space = None",
        "pass",
        "hosts/test_skip_empty.py",
    ),
    Mutant(
        "in a short training geometry does not wait for R",
        "train/optimizer.py",
        "min(MIN_WAIT, position.length / 2)",
        "0",
        "train/test_start.py",
    ),
)
