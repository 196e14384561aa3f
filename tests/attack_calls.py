"""Calls of every public callable with values that no caller should give: for test_fuzz."""

import decimal
import enum
import fractions
import inspect
import os
import random
import signal
import tempfile
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import test_refusals
import torch
from refusals_values import HEIGHT, WIDTH, Entry, image, lights, sensor, unit

import torchvts as vts

LIMIT_S = 20.0
"""CPU seconds: a call that takes longer hangs, as far as the caller can tell."""
BLOCKED_S = 300.0
"""Seconds after which a call must wait for something, however busy the machine is."""

CHEAP_FILES = (
    "Calibration.load", "Calibration.save", "FrozenPipeline.load", "FrozenPipeline.save", "NormalFromLookup.load",
    "NormalFromLookup.save", "NormalFromMLP.load", "NormalFromMLP.save", "Sensor.read_image", "Sensor.save",
    "read_image", "read_presses", "write_image", "gs_sdk.read_calibration_folder", "gs_sdk.read_labels", "stream.open_source",
)  # fmt: skip
"""Entries whose good call is not made by test_refusals, because it needs a file, and that are called here."""


class Colour(enum.IntEnum):
    """An integer that is none."""

    RED = 3


class Liar:
    """Says that it is an array, and fails when it is used as one."""

    __array_interface__ = property(lambda self: {"shape": (3, 4, 4), "typestr": "<f4", "version": 3})

    def __float__(self):
        raise ValueError("no number")

    def __repr__(self):
        return "Liar()"


def values():
    """Names of bad values, and what makes them; each call gets its own."""
    good = image()
    plain = {
        "none": None, "true": True, "nan": float("nan"), "inf": float("inf"), "-inf": -float("inf"), "-0.0": -0.0, "0": 0,
        "-1": -1, "1e308": 1e308, "5e-324": 5e-324, "1e-30": 1e-30, "2**31": 2**31, "2**63": 2**63, "2**64": 2**64,
        "10**400": 10**400, "-10**400": -(10**400), "10**9": 10**9, "1.5": 1.5, "complex": 1 + 2j,
        "fraction": fractions.Fraction(10**400, 3), "decimal": decimal.Decimal("NaN"), "text": "1", "long text": "9" * 100_000,
        "surrogate": "\udcff", "superscript": "\u00b2", "NUL": "a\0b", "empty text": "", "bytes": b"1", "list": [1.0],
        "nested": [[1.0], [2.0, 3.0]], "empty": [], "tuple of text": ("a", "b"), "dict": {"a": 1}, "set": {1},
        "huge list": [10**400] * 3, "class": int, "module": os, "path": Path("no/such"), "self path": Path("."),
        "enum": Colour.RED, "liar": Liar(), "namespace": SimpleNamespace(shape=(3, 4, 4)), "np nan": np.float64("nan"),
        "np int": np.int8(-1), "np bool": np.bool_(True), "np time": np.datetime64("2020"), "np object": np.array([None]),
        "np text": np.array(["a"]), "np structured": np.zeros(3, dtype=[("a", "f4")]), "np masked": np.ma.masked_all((3, 4, 4)),
        "np empty": np.zeros((0, 0)), "np flipped": np.zeros((HEIGHT, WIDTH, 3), np.uint8)[::-1],
        "np big-endian": np.zeros((HEIGHT, WIDTH, 3), ">u2"), "np float16": np.zeros((3, 4, 4), np.float16),
    }  # fmt: skip
    made = {
        "generator": lambda: (v for v in (1, 2)), "lambda": lambda: lambda *a, **k: None, "recursive": recursive,
        "tensor 0-d": lambda: torch.tensor(0.5), "tensor 0-d int": lambda: torch.tensor(3),
        "tensor 0-d bool": lambda: torch.tensor(True), "tensor nan": lambda: torch.tensor(float("nan")),
        "tensor 1": lambda: torch.tensor([0.5]), "tensor (3,)": lambda: torch.tensor([0.5, 0.5, 0.5]),
        "tensor empty": lambda: torch.zeros(0), "tensor (0, 3, h, w)": lambda: torch.zeros(0, 3, HEIGHT, WIDTH),
        "tensor (1, 3, h, 0)": lambda: torch.zeros(1, 3, HEIGHT, 0), "tensor 12-d": lambda: torch.zeros([1] * 12),
        "tensor grad": lambda: torch.tensor(0.5, requires_grad=True), "module": lambda: torch.nn.Identity(),
        "device": lambda: torch.device("meta"), "dtype": lambda: torch.float16,
        "storage": lambda: torch.zeros(3).untyped_storage(), "image": lambda: good, "calibration": unit, "sensor": sensor,
        "lights": lights,
    }  # fmt: skip
    return {name: (lambda value=value: value) for name, value in plain.items()} | made


def recursive():
    found = []
    found.append(found)
    return found


def changes():
    """What is done to a good tensor."""
    return {
        "sparse": lambda t: t.to_sparse(),
        "csr": lambda t: t.reshape(-1, t.shape[-1]).to_sparse_csr() if t.dim() > 1 else t.to_sparse(),
        "meta": lambda t: t.to("meta"), "nested": lambda t: torch.nested.nested_tensor([t, t]),
        "complex": lambda t: t.to(torch.complex64), "half": lambda t: t.half(), "bfloat16": lambda t: t.bfloat16(),
        "float8": lambda t: t.to(torch.float8_e4m3fn), "double": lambda t: t.double(), "int": lambda t: t.to(torch.int64),
        "bool": lambda t: t.bool(), "quantised": lambda t: torch.quantize_per_tensor(t.float(), 0.1, 0, torch.quint8),
        "nan": lambda t: t * float("nan"), "inf": lambda t: t + float("inf"), "huge": lambda t: t.double() * 0 + 1e300,
        "large": lambda t: t * 0 + 3e38, "negative": lambda t: -1.0 - t, "one more dimension": lambda t: t[None],
        "one less dimension": lambda t: t[0], "cut": lambda t: t[..., 1:], "empty": lambda t: t[..., :0],
        "transposed": lambda t: t.transpose(-1, -2), "strided": lambda t: t.flip(-1)[..., ::2],
        "expanded": lambda t: t.flatten()[0].expand(t.shape),
        "channels last": lambda t: t.contiguous(memory_format=torch.channels_last) if t.dim() == 4 else t,
        "grad": lambda t: t.detach().clone().requires_grad_(True), "inference": inference,
        "conj": lambda t: torch.complex(t, t).conj().imag, "parameter": lambda t: torch.nn.Parameter(t.detach().clone()),
        "array": lambda t: t.numpy(), "list": lambda t: t.tolist(), "many": lambda t: t.repeat([2] + [1] * (t.dim() - 1)),
    }  # fmt: skip


def inference(tensor):
    with torch.inference_mode():
        return tensor.clone()


def more_entries():
    """Records whose fields users may change by dataclasses.replace."""
    good = unit()
    fields = ("sensor", "lights", "background", "noise_std", "measured", "report", "response", "markers", "ambient")
    return {
        "Calibration": Entry({name: getattr(good, name) for name in fields}, {}, lambda: vts.Calibration),
        "PointLights.forward-free": Entry(
            {"position_mm": good.lights.position_mm, "albedo": good.lights.albedo}, {}, lambda: vts.PointLights
        ),
    }


def entries():
    found = {name: entry for name, entry in test_refusals.TABLE.items() if entry.run or name in CHEAP_FILES}
    return found | more_entries()


class Slow(BaseException):
    """The call took longer than LIMIT_S or BLOCKED_S."""


def stop_slow_calls():
    signal.signal(signal.SIGPROF, stop)
    signal.signal(signal.SIGALRM, stop)


def stop(_signal, _frame):
    raise Slow


def attempt(call, given):
    """What became of one call: "" where it was accepted or refused in one of the three ways."""
    signal.setitimer(signal.ITIMER_PROF, LIMIT_S)
    signal.setitimer(signal.ITIMER_REAL, BLOCKED_S)
    try:
        call(**given)
    except (TypeError, ValueError, OSError):
        return ""
    except Slow:
        return f"longer than {LIMIT_S:g} CPU seconds, or {BLOCKED_S:g} s"
    except BaseException as error:
        return f"{type(error).__name__}: {str(error)[:160]}"
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.setitimer(signal.ITIMER_REAL, 0.0)
    return ""


def parameters(call, entry):
    """Arguments of a call, also the switches and those that test_refusals does not try."""
    own = [p.name for p in inspect.signature(call).parameters.values() if p.kind not in (p.VAR_POSITIONAL, p.VAR_KEYWORD)]
    return list(dict.fromkeys([*entry.good, *(name for name in own if name != "self")]))


def attack(count, seed):
    """Make ``count`` calls; yields what is called, and what makes the call and tells what came out if it may not."""
    rng = random.Random(seed)
    pool, turns, table = values(), changes(), entries()
    names = sorted(table)
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        for number in range(count):
            name = names[number % len(names)]
            entry = table[name]
            call = entry.call() if entry.call is not None else test_refusals.callables()[name]
            given = test_refusals.filled(entry, Path(folder), call)
            what = []
            for argument in rng.sample(parameters(call, entry), 1 if rng.random() < 0.85 else min(2, len(parameters(call, entry)))):
                tensors = isinstance(given.get(argument), torch.Tensor)
                kind = rng.choice(sorted(turns if tensors and rng.random() < 0.7 else pool))
                try:
                    given[argument] = (
                        turns[kind](given[argument]) if kind in turns and tensors else pool[kind]() if kind in pool else None
                    )
                except (RuntimeError, IndexError):  # a tensor without such a form, as one number has no rows: it is left out
                    kind, given[argument] = "None", None
                what.append(f"{argument}={kind}")
            yield f"{name}({', '.join(what)})", lambda call=call, given=given: attempt(call, given)
        os.chdir("/")
