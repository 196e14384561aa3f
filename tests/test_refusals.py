"""Every public function refuses bad input with a message of one form: `argument: expected ..., got ...: cause`.

The tables in refusals_blocks.py and refusals_tools.py hold for every public callable one call that is accepted, and for each of its
arguments values that are refused. A new public name or a new argument without an entry fails the last two tests. Messages about
files have another form: they begin with the name of the file, and say what is wrong with it (`FILE_FORMS`).
"""

import functools
import importlib
import inspect
import re
import types
import typing
from importlib.util import find_spec

import pytest
import refusals_blocks
import refusals_tools
import torch
from refusals_causes import CAUSES

import torchvts as vts
import torchvts.export
from torchvts.core.geometry import gradient_from_normal, normal_from_gradient

TABLE = refusals_blocks.TABLE | refusals_tools.TABLE
ROOMS = ("calibration", "diagnose", "integration", "model", "normals", "pipeline", "pose", "skin", "training")
"""Rooms whose names are in the table without a prefix, as the names of torchvts itself are."""
MODULES = {
    "gs_sdk.": vts.gs_sdk,
    "export.": torchvts.export,
    "stream.": vts.stream,
    "objects.": vts.scenes.objects,
    "scenes.": vts.scenes,
}
RECORDS = {
    "Calibration", "CalibrationWarning", "Conditions", "ConfidentOutput", "DepthOutput", "Diagnosis", "Diagnosis.of",
    "Finding", "LightFit", "MlpFit", "Registration", "Result", "export.ExportCheck", "export.Format",
    "gs_sdk.GsSdkPress", "DotMotion", "Slip", "objects.Target", "scenes.Scene",
    "stream.Reader", "stream.TactileFrame", "stream.Unreadable",
}  # fmt: skip
"""Results that users get and do not make: their constructors keep what they are given. (Their methods are in the table.)"""
PARTS = {
    "PoseTracker", "TrackedPose",
    "DepthBrightness", "Integrator", "NormalModel", "Refine", "ResponseField", "ResponseModel",
    "SensorPrior", "Shadows", "Solve", "WrappedNormals",
    "as_normal_model", "by_presses", "channel_structure", "check_calibration", "check_domain", "check_sensor",
    "OutputFrame.", "doubts_of",
    "DotMotion.", "scenes.DottedSkin.", "scenes.Drag.", "motion_of_unit", "moved", "read_point_cloud", "stream.FrameCheck.",
    "stream.Overlay", "stream.Recorder.", "stream.Recording.", "stream.StageClock",
    "stream.CameraSettings", "stream.Camera", "stream.Keys", "stream.LiveView", "stream.Sheet", "stream.StreamReport.",
    "stream.TactileStream.rezero", "stream.VideoFile.", "stream.find_camera", "stream.has_screen",
    "read_result", "stream.check_device", "stream.read_background", "stream.read_press_images", "stream.require_rerun",
    "stream.with_background", "unit_pipeline", "unseen_deg", "usual_unseen_deg",
    "StatedError", "StatedError.", "stated_deg", "stated_error_deg", "with_preprocessing", "write_point_cloud",
}  # fmt: skip
"""Names, and with a dot at the end methods, that other tests cover: records, base classes, what one room does for another."""
FREE = {"dtype", "seed", "report", "comment", "clock", "sleep"}
"""Arguments that Python or torch itself checks; switches (bool) are free too."""
FILE_FORMS = (
    r"(no such|key '.*': (unknown|missing)|not an? |folder .* does not exist|expected .*, got |a safetensors file, but not)"
)
"""What a message says about a file after its name."""


@functools.cache
def callables():
    """Every public callable by name: functions, constructors, and methods that take something."""
    found = {}
    rooms = [importlib.import_module(f"torchvts.{room}") for room in ROOMS if find_spec(f"torchvts.{room}")]
    for prefix, module in [("", vts), *(("", room) for room in rooms), *MODULES.items()]:
        names = getattr(module, "__all__", None) or [
            name for name, value in vars(module).items() if getattr(value, "__module__", "") == module.__name__ and name[0] != "_"
        ]
        for name in names:
            value = getattr(module, name)
            if isinstance(value, types.ModuleType) or not callable(value) or typing.is_typeddict(value):
                continue
            found[prefix + name] = value
            for method in methods(prefix + name, value) if inspect.isclass(value) else ():
                found[f"{prefix}{name}.{method}"] = getattr(value, method)
    found |= {call.__name__: call for call in (gradient_from_normal, normal_from_gradient)}
    parts = tuple(part.removesuffix(".") + "." for part in PARTS)
    return {name: value for name, value in found.items() if name not in RECORDS | PARTS and not name.startswith(parts)}


def methods(name, kind):
    """Names of a class's methods for users, those of its bases in torchvts too.

    The other methods of a module are steps of ``forward``, which gives them what they take, unless the table has them.
    """
    own = [base for base in kind.__mro__ if base.__module__.startswith("torchvts")]
    members = {key: member for base in reversed(own) for key, member in vars(base).items() if key[0] != "_"}
    made = [key for key, member in members.items() if isinstance(member, classmethod | staticmethod)]
    plain = [key for key, member in members.items() if inspect.isfunction(member)]
    steps = issubclass(kind, torch.nn.Module)
    return made + [key for key in plain if not steps or key == "forward" or f"{name}.{key}" in TABLE]


def arguments(call):
    """Names of a callable's arguments that can be wrong."""
    parameters = inspect.signature(call).parameters.values()
    return {p.name for p in parameters if p.name not in FREE | {"self"} and p.annotation not in (bool, "bool")}


def made(name):
    entry = TABLE[name]
    if entry.call is not None:
        return entry.call()
    return callables()[name]


def filled(entry, tmp_path, call):
    """The accepted arguments, paths put where they may be."""
    return {
        name: (tmp_path / "out.safetensors" if name in entry.file else tmp_path) if value is ... else value
        for name, value in entry.good.items()
    }


@pytest.mark.parametrize("name", [name for name, entry in TABLE.items() if entry.run])
def test_the_call_of_the_table_is_accepted(name, tmp_path):
    call = made(name)
    call(**filled(TABLE[name], tmp_path, call))


def complaint(name, argument, k, tmp_path):
    """What is wrong with how a bad value is refused; empty if nothing."""
    entry = TABLE[name]
    call, value = made(name), entry.bad[argument][k]
    given = {**filled(entry, tmp_path, call), argument: value}
    case = f"{name}({argument}={str(value)[:60]!r})"
    try:
        call(**given)
    except (TypeError, ValueError, OSError) as error:
        said = str(error)
        as_named = re.match(rf"({entry.named.get(argument, argument)})[^:]*: (.*: )*expected .*, got ", said, re.DOTALL)
        as_file = argument in entry.file and re.match(rf".*: .*{FILE_FORMS}", said, re.DOTALL)
        if as_named or (as_file and "Errno" not in said):
            return ""
        return f"{case}: {type(error).__name__}: {said[:200]}"
    except Exception as error:
        return f"{case}: {type(error).__name__}: {str(error)[:200]}"
    return f"{case}: accepted"


@pytest.mark.parametrize("name", TABLE)
def test_bad_input_is_refused(name, tmp_path):
    complaints = [complaint(name, argument, k, tmp_path) for argument, bad in TABLE[name].bad.items() for k in range(len(bad))]
    assert [text for text in complaints if text] == []
    assert list(tmp_path.iterdir()) == []  # and nothing is left behind


@pytest.mark.parametrize("name, argument, value, cause", CAUSES, ids=[f"{row[0]}-{row[1]}-{row[3][:25]}" for row in CAUSES])
def test_a_refusal_names_its_likely_cause(name, argument, value, cause, tmp_path):
    call = made(name)
    with pytest.raises((TypeError, ValueError), match=cause) as caught:
        call(**{**filled(TABLE[name], tmp_path, call), argument: value})
    assert argument in str(caught.value)


def test_no_public_name_is_missing_from_the_table():
    takers = {name for name, value in callables().items() if arguments(value)}
    assert sorted(takers - set(TABLE)) == []
    assert sorted(set(TABLE) - set(callables())) == []


@pytest.mark.parametrize("name", TABLE)
def test_no_argument_is_missing_from_the_table(name):
    assert sorted(arguments(callables()[name]) - set(TABLE[name].bad) - set(TABLE[name].label)) == []


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_is_refused_by_every_name(dtype, tmp_path):
    """Or taken, where a tensor is only a few numbers."""
    complaints = []
    for name, entry in TABLE.items():
        for argument, value in entry.good.items():
            if name == "Press":  # calibrate refuses their images
                continue
            if not entry.run or not isinstance(value, torch.Tensor) or not value.is_floating_point():
                continue
            call = made(name)
            try:
                call(**{**filled(entry, tmp_path, call), argument: value.to(dtype)})
            except TypeError as error:
                if f"got {dtype}" not in str(error) or "expected" not in str(error):
                    complaints.append(f"{name}({argument}): {error}")
            except Exception as error:
                complaints.append(f"{name}({argument}): {type(error).__name__}: {error}")
            else:
                if value.dim() > 2:
                    complaints.append(f"{name}({argument}): accepted")
    assert complaints == []
