"""Open this asset in Blender 4 or later: surface, environment, lamps and cameras, Z up.

    blender --python open_in_blender.py
    blender --background --python open_in_blender.py -- --camera 003 --render 003.exr --samples 256
    blender --background --python open_in_blender.py -- --camera 003 --render 003.png --percent 50
    blender --background --python open_in_blender.py -- --save asset.blend

Without Blender's program, `python open_in_blender.py --render 003.exr` does the same with the package bpy.
"""

import argparse
import json
import math
import sys
from pathlib import Path

import bpy
from mathutils import Matrix, Vector

HERE = Path(__file__).resolve().parent
SENSOR = 36.0  # mm; only its ratio to the focal length matters


def main(arguments):
    parser = argparse.ArgumentParser(
        prog="open_in_blender.py", description="Open an exported asset in Blender."
    )
    parser.add_argument("--camera", help="name of a view; the first one where none is given")
    parser.add_argument("--render", type=Path, help="render to this file: .exr, linear, or .png")
    parser.add_argument("--samples", type=int, default=128, help="samples per pixel")
    parser.add_argument("--percent", type=int, default=100, help="size of the picture over that of the view")
    parser.add_argument(
        "--source", choices=["glb", "usd"], default="glb", help="where the surface is read from"
    )
    parser.add_argument("--save", type=Path, help="save as this .blend file")
    options = parser.parse_args(arguments)
    described = json.loads((HERE / "scene.json").read_text())
    names = [camera["name"] for camera in described["cameras"]]
    if options.camera not in [None, *names]:
        parser.error(f"no camera {options.camera!r}; there are {', '.join(names)}")

    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    scene.cycles.samples = options.samples
    scene.view_settings.view_transform = "Standard"
    add_surface(options.source)
    add_environment(scene, described["environment"])
    for number, lamp in enumerate(described["lamps"]):
        add_lamp(scene, f"lamp {number}", lamp)
    for camera in described["cameras"]:
        add_camera(scene, camera)
    chosen = options.camera or names[0]
    look_through(scene, next(camera for camera in described["cameras"] if camera["name"] == chosen))
    scene.render.resolution_percentage = options.percent
    if options.save:
        bpy.ops.wm.save_as_mainfile(filepath=str(options.save.resolve()))
    if options.render:
        png = options.render.suffix.lower() == ".png"
        scene.render.image_settings.file_format = "PNG" if png else "OPEN_EXR"
        scene.render.image_settings.color_depth = "8" if png else "32"
        scene.render.filepath = str(options.render.resolve())
        bpy.ops.render.render(write_still=True)


def add_surface(source):
    """The file without its lights: glTF knows no radius and no panels, `add_lamp` does."""
    if source == "usd":
        bpy.ops.wm.usd_import(filepath=str(HERE / "asset.usda"))
    else:
        bpy.ops.import_scene.gltf(filepath=str(HERE / "asset.glb"))
    for thing in [thing for thing in bpy.data.objects if thing.type == "LIGHT"]:
        bpy.data.objects.remove(thing)
    # The material was found with single scattering; Blender adds what that loses, up to half on rough metal.
    for material in bpy.data.materials:
        for node in material.node_tree.nodes:
            if node.type == "BSDF_PRINCIPLED":
                node.distribution = "GGX"


def add_environment(scene, maps):
    scene.world = bpy.data.worlds.new("environment")
    if bpy.app.version < (5, 0):  # later worlds always have them
        scene.world.use_nodes = True
    nodes, links = scene.world.node_tree.nodes, scene.world.node_tree.links
    background = next(node for node in nodes if node.type == "BACKGROUND")
    if maps is None:
        background.inputs["Color"].default_value = (0.0, 0.0, 0.0, 1.0)
        return
    picture = nodes.new("ShaderNodeTexEnvironment")
    picture.image = bpy.data.images.load(str(HERE / maps["blender"]))
    links.new(picture.outputs["Color"], background.inputs["Color"])


def add_lamp(scene, name, lamp):
    """A bulb of I watts per steradian has 4π I watts; a panel sends π I watts to its one side."""
    panel, brightest = lamp["axis"] is not None, max(lamp["intensity"])
    light = bpy.data.lights.new(name, "AREA" if panel else "POINT")
    light.energy = (math.pi if panel else 4.0 * math.pi) * brightest
    light.color = [channel / brightest for channel in lamp["intensity"]] if brightest > 0 else (1.0, 1.0, 1.0)
    thing = bpy.data.objects.new(name, light)
    thing.location = lamp["position"]
    if panel:
        light.shape = "DISK"
        light.size = 2.0 * lamp["radius"]
        thing.rotation_mode = "QUATERNION"
        thing.rotation_quaternion = Vector(lamp["axis"]).to_track_quat("-Z", "Y")
    else:
        light.shadow_soft_size = lamp["radius"]
    scene.collection.objects.link(thing)


def add_camera(scene, camera):
    """Blender's cameras look along −Z with Y up; shifts count widths of the picture. A lens is left out."""
    lens = bpy.data.cameras.new(camera["name"])
    lens.sensor_fit = "HORIZONTAL"
    lens.sensor_width = SENSOR
    lens.lens = camera["fx"] / camera["width"] * SENSOR
    lens.shift_x = (0.5 * camera["width"] - camera["cx"]) / camera["width"]
    lens.shift_y = (camera["cy"] - 0.5 * camera["height"]) / camera["width"] * camera["fx"] / camera["fy"]
    lens.clip_start, lens.clip_end = 1e-3, 1e5
    thing = bpy.data.objects.new(camera["name"], lens)
    thing.matrix_world = Matrix(camera["camera_to_world"]) @ Matrix.Diagonal((1.0, -1.0, -1.0, 1.0))
    scene.collection.objects.link(thing)


def look_through(scene, camera):
    """Render what this camera saw: its size, and the shape of its pixels."""
    scene.camera = scene.objects[camera["name"]]
    scene.render.resolution_x, scene.render.resolution_y = camera["width"], camera["height"]
    tall = camera["fx"] / camera["fy"]
    scene.render.pixel_aspect_x, scene.render.pixel_aspect_y = max(1.0, 1.0 / tall), max(1.0, tall)


if __name__ == "__main__":
    # Blender keeps what comes before "--" for itself.
    inside = "--python" in sys.argv or "-P" in sys.argv
    main(sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else [] if inside else sys.argv[1:])
