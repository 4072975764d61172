"""Every reader of untrusted files: valid files to damage, and a function that reads them."""

from __future__ import annotations

import dataclasses
import json
import pickle
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
import tifffile
import torch
import trimesh
import yaml
from PIL import Image

from neilfpp_method.data.brackets.folder import find_brackets
from neilfpp_method.data.brackets.photo_exposure import photo_exposure, read_exposures
from neilfpp_method.data.capture import Capture, load_capture
from neilfpp_method.data.files.environment_map import read_environment
from neilfpp_method.data.files.images import image_header, read_image, write_exr, write_png
from neilfpp_method.data.formats.pickled_arrays import read_pickled_arrays
from neilfpp_method.data.mesh import read_mesh
from neilfpp_method.data.pixels.dataset import PixelDataset
from neilfpp_method.data.point_cloud import has_normals, read_oriented_ply, read_positions
from neilfpp_method.data.truth import Truth
from neilfpp_method.data.views import Normalization
from neilfpp_method.errors import UserError
from neilfpp_method.export.surface_cache import ExtractedSurface, read_surface, write_surface
from neilfpp_method.prepare.photos import survey
from neilfpp_method.settings.files import read_settings
from neilfpp_method.settings.plain import changed, to_dict
from neilfpp_method.settings.presets import preset
from neilfpp_method.train.checkpoint import FORMAT, load_checkpoint, load_weights, save_checkpoint
from neilfpp_method.train.effects_record import read_plan
from neilfpp_method.train.health_record import read_findings
from neilfpp_method.train.light_record import read_fits
from neilfpp_method.train.run import read_description
from neilfpp_method.train.work_record import read_work
from tests.data.formats import test_blender, test_colmap, test_dtu, test_nerfactor, test_nero, test_transforms
from tests.data.make_capture import make_capture
from tests.data.test_capture_folder import folder as own_capture
from tests.hard_cases.hostile.stored_readers import (
    make_numbers,
    make_pixels,
    make_scan,
    make_step,
    read_numbers,
    read_pixels,
    read_scanned,
    read_step,
)

__all__ = ["READERS", "Reader"]

UNIT = Normalization(1.0, (0.0, 0.0, 0.0))
SIZE = (18, 24)


@dataclass(frozen=True)
class Reader:
    """A reader under test.

    Attributes:
        make: writes whole files into a folder and returns those that are to be damaged, one at a time.
        read: reads what was made, where one file, which is given too, is damaged; raises what it raises, and
            an `AssertionError` where the value is one that it must not return.
        share: of the inputs that a cheap reader gets; those that cost milliseconds get fewer.
    """

    make: Callable[[Path], list[Path]]
    read: Callable[[Path, Path], object]
    share: float = 1.0


def _picture(channels: int, kind: type = np.float32) -> np.ndarray:
    values = np.random.default_rng(0).random((*SIZE, channels))
    values[:9] = 0.25  # constant parts are compressed in another way than noise
    return (values * (255 if kind is np.uint8 else 65_535 if kind is np.uint16 else 1)).astype(kind)


# ----------------------------------------------------------------------------------------------------- images


def _exr(folder: Path) -> list[Path]:
    rgb = _picture(3)
    write_exr(folder / "plain.exr", {"RGBA": _picture(4)})
    write_exr(folder / "half.exr", {"RGB": rgb.astype(np.float16), "depth": _picture(1)[..., 0]})
    packings = {
        "none": OpenEXR.NO_COMPRESSION,
        "rle": OpenEXR.RLE_COMPRESSION,
        "piz": OpenEXR.PIZ_COMPRESSION,
        "pxr24": OpenEXR.PXR24_COMPRESSION,
        "b44": OpenEXR.B44_COMPRESSION,
        "dwaa": OpenEXR.DWAA_COMPRESSION,
    }
    for name, packing in packings.items():
        header = {"compression": packing, "type": OpenEXR.scanlineimage}
        OpenEXR.File(header, {"RGB": rgb.astype(np.float16)}).write(str(folder / f"{name}.exr"))
    tiles = OpenEXR.TileDescription()
    tiles.xSize = tiles.ySize = 8
    OpenEXR.File({"type": OpenEXR.tiledimage, "tiles": tiles}, {"RGB": rgb}).write(str(folder / "tiles.exr"))
    parts = [OpenEXR.Part({"type": OpenEXR.scanlineimage}, {"RGB": rgb}, name) for name in ("one", "other")]
    OpenEXR.File(parts).write(str(folder / "parts.exr"))
    return sorted(folder.iterdir())


def _png(folder: Path) -> list[Path]:
    write_png(folder / "rgb.png", _picture(3, np.uint8))
    write_png(folder / "rgba16.png", _picture(4, np.uint16))
    write_png(folder / "grey.png", _picture(1, np.uint8))
    image = Image.fromarray(_picture(3, np.uint8))
    image.quantize(16).save(folder / "palette.png")
    image.convert("1").save(folder / "bits.png")
    image.convert("LA").save(folder / "grey-alpha.png")
    return sorted(folder.iterdir())


def _tiff(folder: Path) -> list[Path]:
    tifffile.imwrite(folder / "u8.tif", _picture(3, np.uint8), photometric="rgb")
    tifffile.imwrite(folder / "u16.tif", _picture(3, np.uint16), photometric="rgb", byteorder=">")
    tifffile.imwrite(folder / "float.tif", _picture(3), photometric="rgb")
    tifffile.imwrite(folder / "half.tif", _picture(1, np.float16)[..., 0])
    tifffile.imwrite(
        folder / "planes.tif", np.moveaxis(_picture(3), -1, 0), photometric="rgb", planarconfig="separate"
    )
    tifffile.imwrite(folder / "tiles.tif", _picture(3), photometric="rgb", tile=(16, 16))
    for name in ("tiff_lzw", "tiff_deflate", "packbits", "jpeg"):
        Image.fromarray(_picture(3, np.uint8)).save(folder / f"{name}.tif", compression=name)
    return sorted(folder.iterdir())


def _jpeg(folder: Path) -> list[Path]:
    image = Image.fromarray(_picture(3, np.uint8))
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0x829A] = 0.01
    image.save(folder / "rgb.jpg", exif=exif)
    image.save(folder / "progressive.jpg", progressive=True, subsampling=2)
    image.convert("L").save(folder / "grey.jpg")
    image.convert("CMYK").save(folder / "cmyk.jpg")
    return sorted(folder.iterdir())


def _hdr(folder: Path) -> list[Path]:
    cv2.imwrite(str(folder / "packed.hdr"), _picture(3))
    cv2.imwrite(str(folder / "plain.hdr"), _picture(3), [cv2.IMWRITE_HDR_COMPRESSION, 0])
    upright = (folder / "packed.hdr").read_bytes()
    (folder / "rotated.hdr").write_bytes(upright.replace(b"-Y", b"-X", 1).replace(b"+X", b"+Y", 1))
    return sorted(folder.iterdir())


def _read_image(folder: Path, damaged: Path) -> None:
    header = image_header(damaged)
    image = read_image(damaged)
    assert image.pixels.dtype == np.float32
    assert image.pixels.shape[:2] == (header.height, header.width)
    assert image.pixels.shape[2] in (1, 3)
    if not header.hdr:
        assert (image.pixels >= 0).all()
        assert (image.pixels <= 1).all()


def _read_photo(folder: Path, damaged: Path) -> None:
    exposure = photo_exposure(damaged)
    assert exposure is None or (np.isfinite(exposure) and exposure > 0)
    _read_image(folder, damaged)


def _photographs(folder: Path) -> list[Path]:
    """Photographs with EXIF; a RAW file of most cameras is a TIFF file."""
    image = Image.fromarray(_picture(3, np.uint8))
    exif = Image.Exif()
    exif[0x010F], exif[0x0110], exif[0x0112] = "maker", "model", 6
    exif.get_ifd(0x8769).update({0x829A: 0.01, 0x829D: 5.6, 0x8827: 200, 0x920A: 35.0, 0xA405: 50})
    for name in ("a.jpg", "b.png", "c.tif"):
        image.save(folder / name, exif=exif)
    (folder / "d.dng").write_bytes((folder / "c.tif").read_bytes())
    return sorted(folder.iterdir())


def _read_photographs(folder: Path, damaged: Path) -> None:
    photos = survey(folder, "linear")
    for photo in photos.items:
        for number in (photo.exposure, photo.focal):
            assert number is None or (np.isfinite(number) and number > 0)
    for problem in photos.unreadable.values():
        raise UserError(problem, "export it again")


def _environment(folder: Path) -> list[Path]:
    write_exr(folder / "map.exr", {"RGB": _picture(3)})
    return [folder / "map.exr"]


def _read_environment(folder: Path, damaged: Path) -> None:
    radiance = read_environment(damaged)
    assert radiance.isfinite().all()
    assert radiance.amin() >= 0


# ----------------------------------------------------------------------------------------------------- shapes


def _ply(folder: Path) -> list[Path]:
    points = np.random.default_rng(1).normal(size=(20, 6))
    names = "".join(f"property float {name}\n" for name in ("x", "y", "z", "nx", "ny", "nz"))
    for name, order in (("binary_little_endian", "<f4"), ("binary_big_endian", ">f4")):
        head = f"ply\nformat {name} 1.0\nelement vertex 20\n{names}end_header\n"
        (folder / f"{name}.ply").write_bytes(head.encode() + points.astype(order).tobytes())
    head = f"ply\nformat ascii 1.0\ncomment by hand\nelement vertex 20\n{names}end_header\n"
    rows = "\n".join(" ".join(f"{value:.6g}" for value in row) for row in points)
    (folder / "ascii.ply").write_text(head + rows + "\n")
    return sorted(folder.iterdir())


def _read_ply(folder: Path, damaged: Path) -> None:
    assert np.isfinite(read_positions(damaged)).all()
    has_normals(damaged)
    points = read_oriented_ply(damaged)
    assert np.isfinite(points.position).all()
    assert np.isfinite(points.normal).all()


def _mesh(folder: Path) -> list[Path]:
    ball = trimesh.creation.icosphere(subdivisions=1)
    for name in ("binary.ply", "ball.obj", "ball.stl", "ball.off", "ball.glb"):
        ball.export(folder / name)
    ball.export(folder / "ascii.ply", encoding="ascii")
    return sorted(folder.iterdir())


def _read_mesh(folder: Path, damaged: Path) -> None:
    mesh = read_mesh(damaged, UNIT)
    assert mesh.vertices.isfinite().all()
    assert mesh.faces.amin() >= 0
    assert mesh.faces.amax() < len(mesh.vertices)


# --------------------------------------------------------------------------------------------------- captures


def _read_capture(folder: Path, damaged: Path) -> None:
    capture = load_capture(folder)
    inside = folder.resolve()
    for view in capture.views:
        assert view.camera.w2c.shape == (4, 4)
        assert np.isfinite(view.camera.w2c).all()
        for path in (view.image, view.mask, view.valid):
            assert path is None or path.resolve().is_relative_to(inside), f"{path} is outside the capture"
    assert capture.point_cloud is None or capture.point_cloud.resolve().is_relative_to(inside)
    assert np.isfinite(capture.normalization.scale)
    assert capture.normalization.scale > 0
    assert np.isfinite(capture.normalization.center).all()
    pixels = PixelDataset(capture, capture.views)
    batch = pixels.sample(16)
    assert batch.color.isfinite().all()
    assert batch.origins.isfinite().all()
    assert batch.directions.isfinite().all()


def _json_capture(make: Callable[[Path], object], *names: str) -> Callable[[Path], list[Path]]:
    def made(folder: Path) -> list[Path]:
        make(folder)
        return [folder / name for name in names]

    return made


def _colmap(text: bool) -> Callable[[Path], list[Path]]:
    def made(folder: Path) -> list[Path]:
        model = test_colmap.reconstruction(test_colmap.colmap_camera("OPENCV"))
        test_colmap.write(test_colmap.material(folder, masks=None), model, text=text)
        return sorted((folder / "sparse" / "0").iterdir())

    return made


def _nero(folder: Path) -> list[Path]:
    test_nero.scene(folder)
    arrays = (np.eye(4)[:3], np.eye(3))
    for protocol in range(pickle.HIGHEST_PROTOCOL + 1):
        (folder / f"protocol-{protocol}.pickle").write_bytes(pickle.dumps(arrays, protocol))
    return [folder / "0-camera.pkl", *sorted(folder.glob("protocol-*"))]


def _read_nero(folder: Path, damaged: Path) -> None:
    if damaged.suffix == ".pickle":
        assert all(array.dtype == np.float64 for array in read_pickled_arrays(damaged))
    else:
        _read_capture(folder, damaged)


def _truth(folder: Path) -> list[Path]:
    make_capture(folder)
    rng = np.random.default_rng(3)
    arrays = {"points": (5, 3), "normals": (5, 3), "base_color": (5, 3), "roughness": (5,), "metallic": (5,)}
    arrays |= {"wi": (5, 7, 3), "incident": (5, 7, 3), "wo": (5, 2, 3), "outgoing": (5, 2, 3)}
    path = folder / "light" / "light_field_gt.npz"
    path.parent.mkdir()
    np.savez_compressed(
        path, **{name: rng.random(shape).astype(np.float32) for name, shape in arrays.items()}
    )
    return [path]


@cache
def _capture(folder: Path) -> Capture:
    """A capture beside the damaged file."""
    return load_capture(folder)


def _read_truth(folder: Path, damaged: Path) -> None:
    field = Truth(_capture(folder)).light_field()
    assert field is not None
    assert field.position.shape == (len(field.position), 3)
    assert field.position.isfinite().all()
    assert field.incident.isfinite().all()


def _groups(folder: Path) -> list[Path]:
    for name in ("a1", "a2", "b1", "b2"):
        write_png(folder / f"{name}.png", _picture(3, np.uint8))
    (folder / "brackets.json").write_text(json.dumps({"a": ["a1.png", "a2.png"], "b": ["b1.png", "b2.png"]}))
    (folder / "exposures.txt").write_text("a1.png 1/60\na2.png 0.25  # long\nb1.png 1/60\nb2.png 0.25\n")
    (folder / "exposures.json").write_text(json.dumps({"a1.png": 0.1, "a2.png": "1/4"}))
    return [folder / name for name in ("brackets.json", "exposures.txt", "exposures.json")]


def _read_groups(folder: Path, damaged: Path) -> None:
    for name in ("exposures.json", "exposures.txt"):
        known = read_exposures(folder / name)
        assert all(np.isfinite(seconds) and seconds > 0 for seconds in known.values())
    for bracket in find_brackets(folder, folder / "exposures.txt").values():
        assert all(image.resolve().is_relative_to(folder.resolve()) for image in bracket)


# ----------------------------------------------------------------------------------------- settings and runs


def _yaml(folder: Path) -> list[Path]:
    (folder / "all.yaml").write_text(yaml.safe_dump(to_dict(preset("fast"))))
    (folder / "some.yaml").write_text("train: {rays: 512, sdf_steps: 100}\nloss.volume: 1.0 # a comment\n")
    (folder / "tags.yaml").write_text(
        'train: {rays: !!int "512"}\nloss: {mask: &a !!float 5e-4, hessian: *a}\n'
    )
    (folder / "all.json").write_text(json.dumps({"format": FORMAT, "config": to_dict(preset("paper-ngp"))}))
    return sorted(folder.iterdir())


def _read_yaml(folder: Path, damaged: Path) -> None:
    changed(preset("fast"), read_settings(damaged), str(damaged))


class _Small(torch.nn.Linear):
    def __init__(self) -> None:
        super().__init__(3, 4)
        self.register_buffer("mask", torch.ones(4, dtype=torch.bool))


def _checkpoint(folder: Path) -> list[Path]:
    torch.manual_seed(0)
    model, solver = _Small(), _Small()
    optimizer = torch.optim.Adam(model.parameters())
    model(torch.ones(2, 3)).sum().backward()
    optimizer.step()
    save_checkpoint(folder / "last.pt", model, solver, optimizer, 7)
    return [folder / "last.pt"]


def _read_checkpoint(folder: Path, damaged: Path) -> None:
    saved = load_checkpoint(damaged)
    whole = _Small()
    load_weights(whole, saved["model"], folder)
    load_weights(_Small(), saved["light_solver"], folder)
    assert isinstance(saved["step"], int)


RUN_FILES = (
    "config.json",
    "capture.json",
    "scene.json",
    "effects.json",
    "light.json",
    "health.json",
    "work.json",
)


def _run(folder: Path) -> list[Path]:
    contents = {
        "config.json": {"format": FORMAT, "config": to_dict(preset("fast"))},
        "capture.json": {
            "root": "captures/a",
            "test_every": 8,
            "response": "auto",
            "format": None,
            "scale": 1.0,
        },
        "scene.json": {
            "response": "linear",
            "median_radiance": 0.2,
            "radiance_scale": 3.0,
            "background": "constant",
            "background_color": [0.0, 0.1, 0.2],
        },
        "effects.json": {
            "format": 1,
            "request": "auto,-lamps",
            "effects": [],
            "decisions": [
                {
                    "step": 4,
                    "effect": "inter-reflection",
                    "on": True,
                    "by": "evidence",
                    "reason": "why",
                    "evidence": {
                        "what": "hits",
                        "value": 0.1,
                        "deviation": 0.01,
                        "threshold": 0.05,
                        "samples": 100,
                    },
                }
            ],
        },
        "light.json": {
            "format": 1,
            "fits": [{"step": 3, "gain": 0.1, "deviation": 0.01, "points": 99, "lamps": 1}],
        },
        "health.json": {
            "format": 1,
            "verdict": "doubtful",
            "findings": [
                {
                    "case": "fog",
                    "step": 4,
                    "what": "w",
                    "cause": "c",
                    "remedy": "r",
                    "severe": False,
                }
            ],
        },
        "work.json": {"format": 1, "seconds": {"joint": {"rendering": 1.5, "data": 0.2}}},
    }
    for name, content in contents.items():
        (folder / name).write_text(json.dumps(content))
    return [folder / name for name in RUN_FILES]


def _read_run(folder: Path, damaged: Path) -> None:
    config = read_description(folder).config
    read_plan(folder, config)
    fits = read_fits(folder, before=10)
    assert all(dataclasses.is_dataclass(fit) for fit in fits)
    read_findings(folder)
    read_work(folder)


def _surface(folder: Path) -> list[Path]:
    ball = trimesh.creation.icosphere(subdivisions=1)
    vertices, faces = ball.vertices.astype(np.float32), ball.faces.astype(np.int32)
    for name, normals in (("plain", None), ("shaded", vertices)):
        write_surface(folder / f"{name}.npz", ExtractedSurface(vertices, faces, normals), "weights")
    return sorted(folder.iterdir())


def _read_surface(folder: Path, damaged: Path) -> None:
    said: list[str] = []
    surface = read_surface(damaged, "weights", said.append)
    if surface is None:
        raise UserError(*said, "extract it again")
    assert np.isfinite(surface.vertices).all()
    assert surface.faces.min() >= 0
    assert surface.faces.max() < len(surface.vertices)


READERS: Mapping[str, Reader] = {
    "EXR": Reader(_exr, _read_image),
    "PNG": Reader(_png, _read_image),
    "TIFF": Reader(_tiff, _read_image),
    "JPEG": Reader(_jpeg, _read_photo),
    "HDR": Reader(_hdr, _read_image),
    "photographs (EXIF)": Reader(_photographs, _read_photographs, 0.2),
    "environment map": Reader(_environment, _read_environment),
    "points (PLY)": Reader(_ply, _read_ply),
    "mesh (PLY, OBJ, STL, OFF, GLB)": Reader(_mesh, _read_mesh),
    "sfm_scene.json, split.json": Reader(
        _json_capture(lambda root: make_capture(root, masks=True), "inputs/sfm_scene.json", "split.json"),
        _read_capture,
        0.2,
    ),
    "capture.json": Reader(_json_capture(own_capture, "capture.json"), _read_capture, 0.2),
    "transforms.json": Reader(_json_capture(test_transforms.scene, "transforms.json"), _read_capture, 0.2),
    "transforms_train.json": Reader(
        _json_capture(test_blender.scene, "transforms_train.json", "transforms_test.json"), _read_capture, 0.2
    ),
    "metadata.json (NeRFactor)": Reader(
        _json_capture(test_nerfactor.scene, *(f"{name}/metadata.json" for name in ("train_000", "test_000"))),
        _read_capture,
        0.2,
    ),
    "COLMAP, binary": Reader(_colmap(text=False), _read_capture, 0.2),
    "COLMAP, text": Reader(_colmap(text=True), _read_capture, 0.2),
    "NPZ of cameras (DTU)": Reader(_json_capture(test_dtu.scan, "cameras_sphere.npz"), _read_capture, 0.2),
    "NPZ of a light field": Reader(_truth, _read_truth),
    "NPY of a protocol's truth": Reader(make_numbers, read_numbers),
    "scan of DTU (MAT, PLY)": Reader(make_scan, read_scanned, 0.2),
    "pickle (NeRO)": Reader(_nero, _read_nero),
    "brackets and exposures": Reader(_groups, _read_groups),
    "settings (YAML, JSON)": Reader(_yaml, _read_yaml),
    "checkpoint": Reader(_checkpoint, _read_checkpoint),
    "run folder (JSON)": Reader(_run, _read_run),
    "surface in a run folder (NPZ)": Reader(_surface, _read_surface),
    "pixels in a run folder (NPY, JSON)": Reader(make_pixels, read_pixels, 0.2),
    "skipped step": Reader(make_step, read_step),
}
