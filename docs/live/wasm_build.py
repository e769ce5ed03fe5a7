"""Compile the engine for the live pages: `python docs/live/wasm_build.py`.

Numba makes LLVM code from the Python functions of `stad_lab.envs` and `stad_lab.inference`, and the
same LLVM writes WebAssembly. So a browser drives the same car, from the same source. The module is
kept in `engine/`, with the checksums of the sources that it was made from, because making it needs
`wasm-ld` (Debian: lld) and half a minute. `--check` says whether it is newer than its sources.
"""

import argparse
import hashlib
import json
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

HERE = Path(__file__).parent
ENGINE, FACTS = HERE / "engine" / "engine.wasm", HERE / "engine" / "engine.json"
TABLES = HERE / "engine" / "tables.bin"
LIBRARY = HERE.parents[1] / "stad_lab"
SOURCES = (
    "envs/cars.py", "envs/compiling.py", "envs/frames.py", "envs/physics.py", "envs/picture.py",
    "envs/track.py", "inference.py",
)  # fmt: skip
FEATURES = "+bulk-memory,+nontrapping-fptoint,+sign-ext,+simd128"
STACK = 1 << 20  # bytes


def checksums() -> dict[str, str]:
    """The sources of the module: name -> SHA-256."""
    files = {name: LIBRARY / name for name in SOURCES} | {"wasm_build.py": Path(__file__)}
    return {name: hashlib.sha256(file.read_bytes()).hexdigest() for name, file in files.items()}


def keep_modules() -> dict[str, str]:
    """Let Numba keep the LLVM code of each library before it optimises it for this processor.

    Optimised code knows that a pointer has 64 bits; in WebAssembly it has 32.
    """
    from numba.core import codegen

    modules, finalize = {}, codegen.CPUCodeLibrary._finalize_final_module

    def keep(self):
        modules[self.name] = str(self._final_module)
        return finalize(self)

    codegen.CPUCodeLibrary._finalize_final_module = keep
    codegen.CPUCodeLibrary._optimize_functions = lambda self, module: None
    codegen.CPUCodeLibrary._optimize_final_module = lambda self: None
    return modules


def entries() -> list:
    """What the pages call: C functions of pointers, one for each step of the engine."""
    import numba
    from numba import carray, cfunc, types

    from stad_lab import inference
    from stad_lab.envs import physics, picture, track

    inference.BLOCKS = 1
    size, cells = picture.SIZE, picture.CELLS
    texts = picture.MINUS_ZERO + 1
    turns, phases = 2 * picture.MAX_TURN + 1, picture.PHASE_STEPS
    rows, columns = picture.QUARTER_ROWS, picture.QUARTER_COLUMNS
    most, period = track.MAX_TILES, picture.PERIOD
    points, edges = track.find_path, picture.mark_edges
    pave_path, start_car, step_cars = track.pave, physics.start_car, physics.step_cars
    paint_ground, draw_cars = picture.paint, picture.draw_cars
    Ground, Pictures, Layer = picture.Ground, picture.Pictures, inference.Layer
    write_pictures, run_layer, run_memory = (
        inference.write_pictures, inference.run_layer, inference.run_memory
    )  # fmt: skip
    p, i8, f8, f4 = types.CPointer, types.int64, types.float64, types.float32
    u1, u4, u8 = types.uint8, types.uint32, types.uint64
    car_type, road_type = numba.from_dtype(physics.CAR), numba.from_dtype(physics.ROAD)
    ground_types = [p(u1), p(u4), p(u4), p(u4), p(u1), p(u8), p(u1), p(u1)]

    @numba.njit
    def as_ground(texels, quarter, eighth, sixteenth, colors, palette, cell, pattern):
        return Ground(
            carray(texels, (1, size, size)),
            carray(quarter, (1, size // 4, size // 4)),
            carray(eighth, (1, size // 8, size // 8)),
            carray(sixteenth, (1, size // 16, size // 16)),
            carray(colors, (1, 8, 3)),
            carray(palette, (1, 256)),
            carray(cell, (1, cells, cells)),
            carray(pattern, (period, period)),
        )

    @cfunc(i8(p(f8), p(f8)))
    def find_path(draws, path):
        found = points(carray(draws, (12, 2)))
        out = carray(path, (most, 4))
        for i in range(len(found)):
            for j in range(4):
                out[i, j] = found[i, j]
        return len(found)

    @cfunc(i8(p(f8), i8, p(f8), p(f8), p(i8)))
    def pave(path, count, tiles, kerbs, kerb_tiles):
        found, beside, numbers = pave_path(carray(path, (count, 4)))
        carray(tiles, (count, 4, 2))[:] = found
        carray(kerbs, (len(beside), 4, 2))[:] = beside
        carray(kerb_tiles, (len(beside),))[:] = numbers
        return len(beside)

    @cfunc(types.void(p(car_type), p(road_type), p(f8), p(f8), i8))
    def start(car, road, path, tiles, count):
        tiles_ = carray(tiles, (count, 4, 2))
        start_car(carray(car, (1,)), carray(road, (1,)), 0, carray(path, (count, 4)), tiles_, 0.95)

    @cfunc(types.void(p(car_type), p(road_type), p(i8), p(f8), p(f8)))
    def step(car, road, which, action, reward):
        cars, roads = carray(car, (1,)), carray(road, (1,))
        numbers, actions = carray(which, (1,)), carray(action, (1, 3))
        step_cars(cars, roads, numbers, actions, carray(reward, (1,)))

    @cfunc(types.void(p(u1), p(u1)))
    def mark_edges(texels, cell):
        edges(carray(texels, (size, size)), carray(cell, (cells, cells)))

    @cfunc(types.void(*ground_types, p(f8), p(u1), i8, p(u1)))
    def paint(a, b, c, d, e, f, g, h, polygons, kinds, count, colors):
        ground = as_ground(a, b, c, d, e, f, g, h)
        road, kind = carray(polygons, (count, 4, 2)), carray(kinds, (count,))
        paint_ground(ground, 0, road, kind, carray(colors, (8, 3)))

    @cfunc(types.void(*ground_types, p(u1), p(u1), p(u1), p(u1), i8, p(i8), p(car_type),
                      p(road_type), p(f8), i8))  # fmt: skip
    def draw(a, b, c, d, e, f, g, h, car_, score, small, out, side, which, car, road, tiles, bar):
        ground = as_ground(a, b, c, d, e, f, g, h)
        car_pictures = carray(car_, (4, turns, phases, rows, columns, 4))
        scores, smaller = carray(score, (texts, 12, 12)), carray(small, (texts, 8, 8))
        draw_cars(
            carray(out, (1, side, side, 3)), ground, Pictures(car_pictures, scores, smaller),
            carray(which, (1,)), carray(car, (1,)), carray(road, (1,)),
            carray(tiles, (1, most, 4, 2)), bar != 0,
        )  # fmt: skip

    @cfunc(types.void(p(u1), p(u1), p(f4), i8))
    def see(frame, earlier, pictures, channels):
        frames, before = carray(frame, (1, 64, 64, 3)), carray(earlier, (1, 64, 64, 3))
        write_pictures(frames, before, carray(pictures, (1, 64, 64, channels)))

    layer_types = p(i8), i8, i8, i8, i8, p(f4), p(f4), i8, f4

    @numba.njit
    def as_layer(starts, patches, rows_, row, run, weights, bias, outputs, floor):
        blocks = outputs // 16
        return Layer(
            carray(starts, (patches,)), rows_, row, run, carray(weights, (blocks, rows_ * run, 16)),
            carray(bias, (outputs,)), floor,
        )  # fmt: skip

    @cfunc(types.void(p(f4), i8, *layer_types, p(f4)))
    def layer(x, inputs, a, b, c, d, e, f, g, h, i, y):
        run_layer(carray(x, (inputs,)), as_layer(a, b, c, d, e, f, g, h, i), carray(y, (b * h,)))

    @cfunc(types.void(*layer_types, p(f4), p(f4), p(f4), i8))
    def remember(a, b, c, d, e, f, g, h, i, seen, gates, state, hidden):
        run_memory(
            as_layer(a, b, c, d, e, f, g, h, i), carray(seen, (1, e)), carray(gates, (1, h)),
            carray(state, (2, 1, hidden)),
        )  # fmt: skip

    return [find_path, pave, start, step, mark_edges, paint, draw, see, layer, remember]


def build() -> None:
    """Write the module, its tables and its facts."""
    import llvmlite
    import llvmlite.binding as llvm
    import numba
    import numpy as np

    modules = keep_modules()
    functions = entries()
    from stad_lab.envs import physics, picture

    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()
    target = llvm.Target.from_triple("wasm32-unknown-unknown")
    machine = target.create_target_machine(opt=3, features=FEATURES)
    with tempfile.TemporaryDirectory() as folder:
        objects = []
        for function in functions:
            name = re.sub(r"\W", "_", function.__name__)
            code = translate(modules[function._library.name], function.native_name, name, machine)
            objects.append(Path(folder) / f"{name}.o")
            objects[-1].write_bytes(code)
        ENGINE.parent.mkdir(exist_ok=True)
        names = [function.__name__ for function in functions]
        exports = [f"--export={name}" for name in (*names, "__heap_base")]
        linker = ["wasm-ld", "--no-entry", "--allow-undefined", "--strip-all", "-z"]
        linker += [f"stack-size={STACK}", *exports, *map(str, objects), "-o", str(ENGINE)]
        subprocess.run(linker, check=True)
    pictures = picture.make_pictures()
    TABLES.write_bytes(b"".join(np.ascontiguousarray(one).tobytes() for one in pictures))
    facts = {
        "sources": checksums(),
        "made_with": {"numba": numba.__version__, "llvmlite": llvmlite.__version__},
        "module": hashlib.sha256(ENGINE.read_bytes()).hexdigest(),
        "car": layout(physics.CAR),
        "road": layout(physics.ROAD),
        "ground": {"size": picture.SIZE, "rim": picture.RIM, "period": picture.PERIOD,
                   "cells": picture.CELLS},
        "tables": [one.nbytes for one in pictures],
        "colors": picture.ground_colors(*default_colors()).ravel().tolist(),
    }  # fmt: skip
    FACTS.write_text(json.dumps(facts, indent=1) + "\n", encoding="utf-8")
    print(f"{ENGINE}: {ENGINE.stat().st_size:,} bytes; {TABLES}: {TABLES.stat().st_size:,} bytes")


def layout(record) -> dict:
    """The size of a record in bytes, and where its fields begin."""
    return {
        "size": record.itemsize,
        "fields": {name: record.fields[name][1] for name in record.names},
    }


def default_colors() -> list:
    """Background, grass and road, as Gymnasium has them without `domain_randomize`."""
    from stad_lab.envs.cars import COLORS

    return [COLORS[name] for name in ("background", "grass", "road")]


def translate(code: str, symbol: str, name: str, machine) -> bytes:
    """An object file for WebAssembly from the LLVM code of one function, under a short name."""
    import llvmlite.binding as llvm

    code = code.replace("= common global", "= internal global")
    code = re.sub(r'target datalayout = ".*"', f'target datalayout = "{machine.target_data}"', code)
    code = re.sub(r'target triple = ".*"', 'target triple = "wasm32-unknown-unknown"', code)
    module = llvm.parse_assembly(code)
    for one in module.functions:
        if not one.is_declaration:
            one.linkage = "external" if one.name == symbol else "internal"
    module.get_function(symbol).name = name
    options = llvm.create_pipeline_tuning_options(speed_level=3)
    builder = llvm.create_pass_builder(machine, options)
    builder.getModulePassManager().run(module, builder)
    return machine.emit_object(module)


def stale() -> list[str]:
    """The sources that have changed since the module was made."""
    made = json.loads(FACTS.read_text(encoding="utf-8"))["sources"] if FACTS.exists() else {}
    return [name for name, own in checksums().items() if made.get(name) != own]


def main() -> int:
    """Build the module, or say what is newer than it: the exit status is 1 if anything is."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--check", action="store_true", help="build nothing, name newer sources")
    if parser.parse_args().check:
        found = stale()
        print("\n".join(f"newer than the module: {name}" for name in found) or "up to date")
        return int(bool(found))
    with tempfile.TemporaryDirectory() as cache:
        os.environ["NUMBA_CACHE_DIR"] = cache
        # For any processor: the module must not depend on the one that makes it.
        os.environ["NUMBA_CPU_NAME"], os.environ["NUMBA_CPU_FEATURES"] = "generic", ""
        build()
    return 0


if __name__ == "__main__":
    sys.exit(main())
