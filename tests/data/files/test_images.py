"""Image files: files that other libraries write are read by the package, and the other way round."""

from __future__ import annotations

import resource
import struct
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
import pytest
import tifffile
from PIL import EpsImagePlugin, Image

from neilfpp_method.data.files.atomic_file import replacing
from neilfpp_method.data.files.images import image_header, read_image, write_exr, write_png
from neilfpp_method.errors import UserError

HEIGHT, WIDTH = 5, 7
RGB = np.random.default_rng(0).uniform(0, 4, (HEIGHT, WIDTH, 3)).astype(np.float32)
BYTES = np.random.default_rng(1).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)


def openexr(path: Path, channels: dict, **header) -> Path:
    OpenEXR.File({"type": OpenEXR.scanlineimage, **header}, channels).write(str(path))
    return path


def test_exr_float_and_half(tmp_path: Path) -> None:
    write_exr(tmp_path / "float.exr", {"RGB": RGB[:, ::-1]})  # not contiguous
    write_exr(tmp_path / "half.exr", {"RGB": RGB.astype(np.float16), "Z": RGB[..., 0]})
    assert np.array_equal(OpenEXR.File(str(tmp_path / "float.exr")).channels()["RGB"].pixels, RGB[:, ::-1])
    assert np.array_equal(read_image(tmp_path / "float.exr").pixels, RGB[:, ::-1])
    half = read_image(tmp_path / "half.exr")
    assert np.array_equal(half.pixels, RGB.astype(np.float16).astype(np.float32))
    assert half.hdr
    assert half.alpha is None
    assert half.pixels.flags.c_contiguous


def test_exr_channels(tmp_path: Path) -> None:
    planes = {name: np.ascontiguousarray(RGB[..., i]) for i, name in enumerate("RGB")}
    alpha = np.full((HEIGHT, WIDTH), 0.25, np.float32)
    mixed = {**planes, "R": planes["R"].astype(np.float16), "A": alpha, "normal.X": planes["G"]}
    image = read_image(openexr(tmp_path / "mixed.exr", mixed))
    assert np.array_equal(image.pixels[..., 1:], RGB[..., 1:])
    assert np.allclose(image.pixels[..., 0], RGB[..., 0], rtol=1e-3)
    assert (image.alpha == 0.25).all()
    for name in ("Y", "Z", "depth"):
        assert np.array_equal(
            read_image(openexr(tmp_path / "one.exr", {name: planes["R"]})).pixels, RGB[..., :1]
        )
    xyz = dict(zip("XYZ", planes.values(), strict=True))
    assert np.array_equal(read_image(openexr(tmp_path / "xyz.exr", xyz)).pixels, RGB)
    with pytest.raises(UserError, match=r"two\.exr.*u, v"):
        read_image(openexr(tmp_path / "two.exr", {"u": planes["R"], "v": planes["G"]}))


@pytest.mark.parametrize(("left", "top"), [(2, 3), (-4, -1), (3, -2), (20, 0)])
def test_exr_stored_window_is_placed_in_its_frame(tmp_path: Path, left: int, top: int) -> None:
    data = ((left, top), (left + WIDTH - 1, top + HEIGHT - 1))
    path = openexr(tmp_path / "crop.exr", {"RGB": RGB}, dataWindow=data, displayWindow=((0, 0), (9, 5)))
    expected = np.zeros((6, 10, 3), np.float32)
    for y in range(6):
        for x in range(10):
            if 0 <= y - top < HEIGHT and 0 <= x - left < WIDTH:
                expected[y, x] = RGB[y - top, x - left]
    assert np.array_equal(read_image(path).pixels, expected)
    assert (image_header(path).width, image_header(path).height) == (10, 6)


@pytest.mark.parametrize(("dtype", "full"), [(np.uint8, 255), (np.uint16, 65535)])
@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_integer_samples_scale_to_one(tmp_path: Path, suffix: str, dtype: type, full: int) -> None:
    samples = np.random.default_rng(2).integers(0, full + 1, (HEIGHT, WIDTH, 4)).astype(dtype)
    samples[0, 0] = full
    cv2.imwrite(str(tmp_path / f"i{suffix}"), samples)  # BGRA
    image = read_image(tmp_path / f"i{suffix}")
    assert np.allclose(image.pixels, samples[..., [2, 1, 0]] / full, atol=1e-7)
    assert np.allclose(image.alpha, samples[..., 3] / full, atol=1e-7)
    assert image.pixels[0, 0, 0] == 1
    assert not image.hdr


@pytest.mark.parametrize("kind", ["8", "16", "float"])
def test_an_alpha_that_is_opaque_everywhere_is_ignored(tmp_path: Path, kind: str) -> None:
    def alpha_of(values: np.ndarray) -> np.ndarray | None:
        if kind == "float":
            write_exr(tmp_path / "a.exr", {"RGBA": values.astype(np.float32)})
            return read_image(tmp_path / "a.exr").alpha
        write_png(tmp_path / "a.png", (values * (2 ** int(kind) - 1)).astype(f"uint{kind}"))
        return read_image(tmp_path / "a.png").alpha

    values = np.ones((HEIGHT, WIDTH, 4))
    assert alpha_of(values) is None
    values[2, 3, 3] = 0
    assert alpha_of(values)[2, 3] == 0


@pytest.mark.parametrize("suffix", [".tif", ".hdr"])
def test_floating_point_files_are_hdr(tmp_path: Path, suffix: str) -> None:
    cv2.imwrite(str(tmp_path / f"f{suffix}"), RGB)
    image = read_image(tmp_path / f"f{suffix}")
    assert image.hdr
    assert image_header(tmp_path / f"f{suffix}").hdr
    assert np.allclose(image.pixels, RGB[..., ::-1], atol=0 if suffix == ".tif" else 4 / 128)


def test_the_exposure_of_a_radiance_file_is_divided_out(tmp_path: Path) -> None:
    path = tmp_path / "a.hdr"
    cv2.imwrite(str(path), RGB)
    before = read_image(path).pixels
    path.write_bytes(path.read_bytes().replace(b"\n\n", b"\nEXPOSURE=0.5\nEXPOSURE= 8.0\n\n", 1))
    assert np.allclose(read_image(path).pixels, before / 4)
    factors = b"COLORCORR=2.0 1.0 0.25\n\n"
    path.write_bytes(path.read_bytes().replace(b"\n\n", b"\n" + b"# written by a tool\n" * 400 + factors, 1))
    assert np.allclose(read_image(path).pixels, before / 4 / [2.0, 1.0, 0.25])
    path.write_bytes(path.read_bytes().replace(b"=0.5", b"=0.0"))
    with pytest.raises(
        UserError, match=r"a\.hdr: cannot be read \(an exposure or a colour correction of 0\)"
    ):
        read_image(path)


@pytest.mark.parametrize("kind", ["NO", "ZIP", "PIZ", "RLE"])
@pytest.mark.parametrize("layout", ["scanline", "tiled"])
def test_exr_compressions_and_layouts(tmp_path: Path, kind: str, layout: str) -> None:
    header = {
        "compression": getattr(OpenEXR, f"{kind}_COMPRESSION"),
        "type": getattr(OpenEXR, f"{layout}image"),
    }
    if layout == "tiled":
        header["tiles"] = OpenEXR.TileDescription()
    assert np.array_equal(read_image(openexr(tmp_path / "a.exr", {"RGB": RGB}, **header)).pixels, RGB)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float16, np.float32, np.float64])
@pytest.mark.parametrize(
    "layout", [{}, {"tile": (16, 16)}, {"byteorder": ">"}, {"compression": "zlib"}, {"planarconfig": 2}]
)
def test_tiff_of_another_writer(tmp_path: Path, dtype: type, layout: dict) -> None:
    full = np.iinfo(dtype).max if np.issubdtype(dtype, np.integer) else 1
    samples = (RGB if full == 1 else RGB / 4 * full).astype(dtype)
    stored = samples.transpose(2, 0, 1) if "planarconfig" in layout else samples
    tifffile.imwrite(tmp_path / "a.tif", stored, photometric="rgb", **layout)
    image = read_image(tmp_path / "a.tif")
    assert np.allclose(image.pixels, samples.astype(np.float64) / full, atol=1e-7)
    assert image.hdr == (full == 1)


def test_radiance_hdr_by_the_definition_of_rgbe(tmp_path: Path) -> None:
    rgbe = np.random.default_rng(5).integers(0, 256, (HEIGHT, WIDTH, 4), dtype=np.uint8)
    rgbe[..., 3] = rgbe[..., 3] // 16 + 120
    head = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y %d +X %d\n" % (HEIGHT, WIDTH)
    (tmp_path / "a.hdr").write_bytes(head + rgbe.tobytes())
    expected = rgbe[..., :3] * np.exp2(rgbe[..., 3:].astype(np.float64) - 136)
    assert np.allclose(read_image(tmp_path / "a.hdr").pixels, expected, rtol=1e-6)


@pytest.mark.parametrize("slow", ["-Y", "+Y", "-X", "+X"])
@pytest.mark.parametrize("packed", [True, False])
@pytest.mark.parametrize("fast_sign", ["+", "-"])
def test_radiance_rows_in_any_order(tmp_path: Path, slow: str, fast_sign: str, packed: bool) -> None:
    path, picture = tmp_path / "a.hdr", np.random.default_rng(6).uniform(0.5, 1, (20, 30, 3))
    fast = fast_sign + ("X" if slow[1] == "Y" else "Y")
    stored = picture[:: 1 if "-Y" in (slow, fast) else -1, :: 1 if "+X" in (slow, fast) else -1]
    stored = stored if slow[1] == "Y" else stored.transpose(1, 0, 2)
    rows, columns = stored.shape[:2]
    cv2.imwrite(str(path), stored[..., ::-1].astype(np.float32), [cv2.IMWRITE_HDR_COMPRESSION, int(packed)])
    size = f"{slow} {rows} {fast} {columns}".encode()
    path.write_bytes(path.read_bytes().replace(b"-Y %d +X %d" % (rows, columns), size, 1))
    assert (image_header(path).width, image_header(path).height) == (30, 20)
    assert np.allclose(read_image(path).pixels, picture, atol=1 / 128)


@pytest.mark.parametrize("size", [b"-Y 5 +Y 7", b"Y 5 X 7", b"5 7 + -"])
def test_a_radiance_file_without_a_size_is_refused(tmp_path: Path, size: bytes) -> None:
    (tmp_path / "a.hdr").write_bytes(b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n" + size + b"\n" + bytes(140))
    with pytest.raises(UserError, match="not of the form -Y 480"):
        read_image(tmp_path / "a.hdr")


@pytest.mark.parametrize("mode", ["L", "LA", "P", "1"])
def test_png_kinds(tmp_path: Path, mode: str) -> None:
    Image.fromarray(BYTES).convert(mode).save(tmp_path / "kind.png")
    expected = np.asarray(Image.fromarray(BYTES).convert(mode).convert("RGB")) / 255
    assert np.allclose(
        read_image(tmp_path / "kind.png").pixels, expected[..., : 1 if mode in "L1" else 3], atol=1e-6
    )


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".JPG"])
def test_png_and_jpeg_are_read_by_their_content(tmp_path: Path, suffix: str) -> None:
    """A renamed PNG keeps its alpha, and a renamed JPEG that is cut off is refused, not filled with grey."""
    rgba = np.dstack([BYTES, BYTES[..., :1]])
    Image.fromarray(rgba).save(tmp_path / f"a{suffix}", format="PNG")
    image = read_image(tmp_path / f"a{suffix}")
    assert np.allclose(image.pixels, BYTES / 255, atol=1e-6)
    assert np.allclose(image.alpha, BYTES[..., 0] / 255, atol=1e-6)
    Image.fromarray(BYTES).save(tmp_path / "b.jpg", quality=100)
    (tmp_path / f"c{suffix}").write_bytes((tmp_path / "b.jpg").read_bytes()[:-60])
    with pytest.raises(UserError, match="cannot be read"):
        read_image(tmp_path / f"c{suffix}")


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_postscript_under_another_name_starts_no_program(tmp_path: Path, monkeypatch, suffix: str) -> None:
    """Pillow would start Ghostscript, if there is one on the path, to draw it."""
    started = tmp_path / "started"
    (tmp_path / "gs").write_text(f"#!/bin/sh\necho > {started}\n")
    (tmp_path / "gs").chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr(EpsImagePlugin, "gs_binary", None)  # the result of an earlier search
    head = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 20 20\n%%EndComments\nshowpage\n%%EOF\n"
    (tmp_path / f"a{suffix}").write_bytes(head)
    with pytest.raises(UserError, match="cannot be read"):
        read_image(tmp_path / f"a{suffix}")
    assert not started.exists()


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_the_colours_of_a_tiff_are_not_multiplied_by_its_alpha(tmp_path: Path, dtype: type) -> None:
    full = np.iinfo(dtype).max if np.issubdtype(dtype, np.integer) else 1
    colors, alpha = (BYTES / 255 * full).astype(dtype), (BYTES[..., :1] / 255 * full).astype(dtype)
    stored = np.dstack([colors, alpha])
    tifffile.imwrite(tmp_path / "a.tif", stored, photometric="rgb", extrasamples=["unassalpha"])
    image = read_image(tmp_path / "a.tif")
    assert np.allclose(image.pixels, colors / full, atol=1e-6)
    assert np.allclose(image.alpha, alpha[..., 0] / full, atol=1e-6)
    grey = stored[..., [0, 3]]
    tifffile.imwrite(
        tmp_path / "grey.tif",
        grey,
        photometric="minisblack",
        planarconfig="contig",
        extrasamples=["unassalpha"],
    )
    assert np.allclose(read_image(tmp_path / "grey.tif").alpha, alpha[..., 0] / full, atol=1e-6)


def test_a_tiff_of_cielab_colours_is_refused(tmp_path: Path) -> None:
    Image.fromarray(BYTES).convert("LAB").save(tmp_path / "lab.tif")
    with pytest.raises(UserError, match=r"lab\.tif: cannot be read \(its colours are CIELAB, not RGB\)"):
        read_image(tmp_path / "lab.tif")


def test_a_tiff_with_an_orientation_or_further_channels_is_read_as_stored(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "a.tif", BYTES, photometric="rgb", extratags=[(274, "H", 1, 6, True)])
    assert np.allclose(read_image(tmp_path / "a.tif").pixels, BYTES / 255, atol=1e-6)
    stored = np.dstack([RGB, RGB[..., :2]])
    tifffile.imwrite(tmp_path / "b.tif", stored, photometric="rgb", extrasamples=["unspecified"] * 2)
    image = read_image(tmp_path / "b.tif")
    assert np.array_equal(image.pixels, RGB)
    assert image.alpha is None


@pytest.mark.parametrize("compression", [None, "lzw"])
def test_the_thumbnail_of_a_tiff_is_not_the_image(tmp_path: Path, compression: str | None) -> None:
    small, large = (np.asarray(Image.fromarray(BYTES).resize(size)) for size in ((3, 2), (WIDTH, HEIGHT)))
    with tifffile.TiffWriter(tmp_path / "plain.tif") as file:
        file.write(small, photometric="rgb", subfiletype=1)
        file.write(large, photometric="rgb")
    # Pillow writes the compression that OpenCV decodes, but not the tag of a reduced page by itself.
    pages = [Image.fromarray(page) for page in (small, large)]
    pages[0].encoderinfo = {"tiffinfo": {254: 1}}
    pages[0].save(tmp_path / "lzw.tif", compression="tiff_lzw", save_all=True, append_images=pages[1:])
    path = tmp_path / f"{compression or 'plain'}.tif"
    assert tifffile.TiffFile(path).pages[0].is_reduced
    assert (image_header(path).width, image_header(path).height) == (WIDTH, HEIGHT)
    assert np.allclose(read_image(path).pixels, BYTES / 255, atol=1e-6)


def test_jpeg_keeps_the_stored_orientation(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x0112] = 6  # "rotate by 90° to show"
    flat = np.full((HEIGHT, WIDTH, 3), (200, 100, 50), np.uint8)
    Image.fromarray(flat).save(tmp_path / "turned.jpg", exif=exif, quality=100)
    assert np.allclose(read_image(tmp_path / "turned.jpg").pixels, flat / 255, atol=3 / 255)
    assert (image_header(tmp_path / "turned.jpg").width, image_header(tmp_path / "turned.jpg").height) == (
        WIDTH,
        HEIGHT,
    )


@pytest.mark.parametrize("mode", ["P", "L", "RGB"])
def test_the_transparent_colour_of_a_png_is_its_alpha(tmp_path: Path, mode: str) -> None:
    """Tools that shrink files store cut-out objects with a palette."""
    picture = Image.fromarray(BYTES).convert(mode)
    key = picture.getpixel((3, 2))
    picture.save(tmp_path / "cut.png", transparency=key)
    image = read_image(tmp_path / "cut.png")
    expected = np.array([[picture.getpixel((x, y)) != key for x in range(WIDTH)] for y in range(HEIGHT)])
    assert np.array_equal(image.alpha, expected)
    assert np.allclose(image.pixels, np.asarray(picture.convert("RGB")) / 255, atol=1e-6)


def test_written_png_is_rgb(tmp_path: Path) -> None:
    write_png(tmp_path / "new" / "a.png", BYTES)
    assert np.array_equal(np.asarray(Image.open(tmp_path / "new" / "a.png")), BYTES)
    write_png(tmp_path / "deep.png", BYTES[..., 0].astype(np.uint16) * 257)
    assert np.allclose(read_image(tmp_path / "deep.png").pixels[..., 0], BYTES[..., 0] / 255, atol=1e-7)
    with pytest.raises(ValueError, match="float32"):
        write_png(tmp_path / "no.png", RGB)


def test_a_failed_write_keeps_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "kept.txt"
    path.write_text("old")

    def killed() -> None:
        with replacing(path) as temporary:
            temporary.write_text("half")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        killed()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


# ----------------------------------------------------------------------------------------- untrusted files


@pytest.mark.parametrize("suffix", [".exr", ".png", ".tif", ".jpg", ".hdr"])
@pytest.mark.parametrize("damage", ["cut", "empty", "garbage", "missing"])
def test_damaged_files_are_named(tmp_path: Path, suffix: str, damage: str) -> None:
    path = tmp_path / f"bad{suffix}"
    noise = np.random.default_rng(3).uniform(0, 1, (64, 64, 3)).astype(np.float32)
    if suffix == ".exr":
        write_exr(path, {"RGB": noise})
    else:
        cv2.imwrite(str(path), noise if suffix == ".hdr" else (noise * 255).astype(np.uint8))
    content = {
        "cut": path.read_bytes()[: path.stat().st_size // 2],
        "empty": b"",
        "garbage": b"no image at all " * 9,
    }
    path.unlink() if damage == "missing" else path.write_bytes(content[damage])
    with pytest.raises(UserError, match=rf"bad\{suffix}: (cannot be read|no such image)"):
        read_image(path)


def test_a_forged_size_is_refused_before_anything_is_allocated(tmp_path: Path) -> None:
    write_exr(tmp_path / "a.exr", {"RGB": RGB})
    data = (tmp_path / "a.exr").read_bytes()
    for window in (b"dataWindow", b"displayWindow"):
        at = data.index(window + b"\0box2i\0") + len(window) + 7 + 4
        (tmp_path / "a.exr").write_bytes(
            data[:at] + struct.pack("<4i", 0, 0, 199_999, 199_999) + data[at + 16 :]
        )
        with pytest.raises(UserError, match=r"a\.exr: the header says 200000×200000"):
            read_image(tmp_path / "a.exr")
    cv2.imwrite(str(tmp_path / "a.hdr"), RGB)
    (tmp_path / "a.hdr").write_bytes(
        (tmp_path / "a.hdr").read_bytes().replace(b"-Y 5 +X 7", b"-Y 40000 +X 40000")
    )
    with pytest.raises(UserError, match="40000×40000"):
        image_header(tmp_path / "a.hdr")
    write_png(tmp_path / "a.png", BYTES)
    data = (tmp_path / "a.png").read_bytes()
    (tmp_path / "a.png").write_bytes(data[:16] + struct.pack(">2I", 60_000, 60_000) + data[24:])
    with pytest.raises(UserError, match=r"a\.png"):
        read_image(tmp_path / "a.png")


def test_a_png_chunk_that_is_longer_than_the_file_is_not_decoded(tmp_path: Path, monkeypatch) -> None:
    """OpenCV would allocate the stated length of a gigabyte before it reads."""
    path = tmp_path / "a.png"
    write_png(path, BYTES)
    whole = path.read_bytes()
    at = whole.index(b"IDAT")
    path.write_bytes(whole[: at - 4] + struct.pack(">I", 2**30) + whole[at:])
    monkeypatch.setattr(cv2, "imread", lambda *_: pytest.fail("decoded"))
    with pytest.raises(UserError, match=r"a\.png: cannot be read \(a chunk is longer than the file\)"):
        read_image(path)
    path.write_bytes(whole[:-3])
    with pytest.raises(UserError, match="a chunk is longer than the file"):
        read_image(path)
    path.write_bytes(whole[: -8 - 4 + 3])
    with pytest.raises(UserError, match="it ends within the head of a chunk"):
        read_image(path)


def test_a_header_of_100_000_columns_costs_no_memory(tmp_path: Path) -> None:
    write_exr(tmp_path / "wide.exr", {"RGB": RGB})
    data = bytearray((tmp_path / "wide.exr").read_bytes())
    for window in (b"dataWindow", b"displayWindow"):
        at = data.index(window + b"\0box2i\0") + len(window) + 7 + 4
        data[at : at + 16] = struct.pack("<4i", 0, 0, 99_999, 99_999)
    (tmp_path / "wide.exr").write_bytes(data)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for read in (image_header, read_image):
        with pytest.raises(UserError, match="the header says 100000×100000"):
            read(tmp_path / "wide.exr")
    assert (
        resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 50_000
    )  # kB; the pixels would be 120 GB


def test_unknown_formats_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a.webp").write_bytes(b"RIFF")
    with pytest.raises(UserError, match="a folder where an image is wanted; name a file in it"):
        read_image(tmp_path)
    with pytest.raises(UserError, match=r"a\.webp: not an image format that is read; use one of \.exr"):
        image_header(tmp_path / "a.webp")
