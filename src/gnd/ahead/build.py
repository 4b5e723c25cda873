"""Compile the library of kernels: `python -m gnd.ahead.build FILE [SCENE ...]`, in a process of its own.

The scenes are the warm-ups of the programs: they call every kernel with the types that it gets on the road. What is
called is recorded; numba compiles it for the processor that NUMBA_CPU_NAME names, with the same options and passes as
when it compiles in a running program; its optimised code is then written as position-independent object files, and a C
compiler links them with numba's helpers, which need no numba.
"""

import importlib
import json
import os
import shlex
import subprocess
import sys
import sysconfig
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from gnd.ahead.fingerprint import fingerprint
from gnd.ahead.library import VARIABLE, UnfitLibrary, environment, name_of, sealed, type_name
from gnd.gnd_map.errors import GndError
from gnd.gnd_map.jit import LazyKernel, record_calls

SCENES: Final = ("gnd.tile_store.warm", "gnd.cloud_merger.warm", "gnd.vehicle_agent.warm")
"""Modules whose `warm_up` calls the kernels of a program; one whose extra is not installed is left out."""
V3: Final = "x86-64-v3"
"""What is compiled for where this machine can run it; else any processor of its kind."""
_OF_V3: Final = ("avx2", "bmi", "bmi2", "f16c", "fma", "lzcnt", "movbe")
_ANY: Final = {"x86_64": "x86-64"}
_ENVIRONMENT: Final = "_ZN08NumbaEnv"
_EMPTY: Final = "#include <Python.h>\nPyObject *nothing(void) { return NULL; }\n"
_C_FLAGS: Final = ("-O2", "-fPIC", "-fvisibility=hidden", "-w")


class CannotBuild(GndError):
    """A library of kernels cannot be compiled here; the message says what is missing."""


@dataclass(frozen=True, slots=True)
class Entry:
    """Machine code of one kernel for one tuple of types.

    Attributes:
        kernel: of which it is.
        arguments: the types, as the manifest writes them.
        wrapper: symbol of the function that Python calls.
        slots: by symbol of an environment its pickled constants.
        code: an object file.
    """

    kernel: LazyKernel
    arguments: list[list[Any]]
    wrapper: str
    slots: dict[str, bytes]
    code: bytes


def build(path: Path, scenes: Sequence[str] = SCENES) -> dict[str, Any]:
    """Compile a library, and return what was made: numbers, bytes, and kernels that were left out with the reason.

    Raises:
        CannotBuild: no C compiler, or it refuses; nothing is written then.
    """
    _try_compilers()
    called = recorded(scenes)
    entries, left_out = [], {}
    for kernel, types in called:
        try:
            entries.append(_entry(kernel, types))
        except CannotBuild as error:
            left_out[f"{name_of(kernel)}{types}"] = str(error)
    manifest = _manifest(entries)
    with tempfile.TemporaryDirectory(prefix="gnd-kernels-") as folder:
        linked = _linked(Path(folder), entries, manifest)
        content = sealed(linked.read_bytes())
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f"{path.name}.{os.getpid()}.part")
    partial.write_bytes(content)
    partial.replace(path)
    return {
        "file": str(path),
        "bytes": len(content),
        "cpu": cpu(),
        "kernels": len(manifest["kernels"]),
        "entries": len(entries),
        "left_out": left_out,
    }


def cpu() -> str:
    """The processor that is compiled for, as LLVM calls it; the warm-ups run on this machine, too."""
    import llvmlite.binding as llvm

    machine = environment()["machine"]
    if machine == "x86_64" and all(llvm.get_host_cpu_features().get(one) for one in _OF_V3):
        return V3
    return _ANY.get(machine, "generic")


def compilers() -> tuple[list[str], list[str]]:
    """The C and the C++ compiler with which this Python builds extensions, or those of CC and CXX.

    Raises:
        CannotBuild: one of them does not answer.
    """
    found = []
    for variable, default in (("CC", "cc"), ("CXX", "c++")):
        words = shlex.split(os.environ.get(variable) or default)
        try:
            subprocess.run([*words, "--version"], capture_output=True, check=True)  # noqa: S603 - asked for by the user
        except (OSError, subprocess.CalledProcessError):
            raise CannotBuild(f"no compiler: {shlex.join(words)} does not run ({variable}); numba is used") from None
        found.append(words)
    return found[0], found[1]


def recorded(scenes: Sequence[str]) -> list[tuple[LazyKernel, tuple[Any, ...]]]:
    """Run the scenes; return which kernels Python called, with numba's types of their arguments, each once."""
    called: dict[tuple[str, tuple[Any, ...]], LazyKernel] = {}

    def record(kernel: LazyKernel, arguments: tuple[Any, ...]) -> None:
        types = tuple(kernel.dispatcher.typeof_pyval(one) for one in arguments)
        called.setdefault((name_of(kernel), types), kernel)

    record_calls(record)
    for name in scenes:
        try:
            module = importlib.import_module(name)
        except ModuleNotFoundError as error:
            if error.name is not None and error.name.startswith("gnd"):
                raise
            continue  # an extra that is not installed
        module.warm_up()
    return [(kernel, types) for (_, types), kernel in called.items()]


def _entry(kernel: LazyKernel, types: tuple[Any, ...]) -> Entry:
    """Machine code of what numba has compiled.

    Raises:
        CannotBuild: a type that only numba recognises, or code that is bound to this process.
    """
    arguments = [_argument(one) for one in types]
    compiled = kernel.dispatcher.overloads.get(types)
    if compiled is None:
        raise CannotBuild("numba compiled it for other types than these")
    if compiled.library.has_dynamic_globals or compiled.lifted:
        raise CannotBuild("its code holds addresses of this process")
    wrapper = compiled.fndesc.llvm_cpython_wrapper_name
    module = compiled.library._get_module_for_linking()  # whether it was compiled here or found in a cache
    return Entry(kernel, arguments, wrapper, _slots(module), _object_code(module, wrapper))


def _argument(given: Any) -> list[Any]:
    """A type of numba's as the manifest writes it: what, kind, layout, writeable, itemsize, ndim, class, parts."""
    from numba import types
    from numba.np.numpy_support import as_dtype

    if isinstance(given, types.Array) and given.aligned and isinstance(given.dtype, types.Number | types.Boolean):
        dtype = as_dtype(given.dtype)
        return ["A", dtype.kind, given.layout, int(given.mutable), dtype.itemsize, given.ndim, "", []]
    for plain, what in ((types.int64, "i"), (types.float64, "d"), (types.boolean, "b")):
        if given == plain:
            return [what, "", "", 0, 0, 0, "", []]
    if isinstance(given, types.Number):
        return ["s", "", "", 0, 0, 0, type_name(as_dtype(given).type), []]
    if isinstance(given, types.NamedTuple | types.NamedUniTuple):
        parts = [_argument(one) for one in given.types]
        return ["N", "", "", 0, 0, 0, type_name(given.instance_class), parts]
    if isinstance(given, types.Tuple | types.UniTuple):
        return ["T", "", "", 0, 0, 0, "", [_argument(one) for one in given.types]]
    raise CannotBuild(f"an argument of type {given}")


def _slots(module: Any) -> dict[str, bytes]:
    """The constants of a kernel and of those in it, pickled, by the symbol of the variable that holds them."""
    from numba.core import serialize
    from numba.core.environment import lookup_environment

    slots = {}
    for variable in module.global_variables:
        if not variable.name.startswith(_ENVIRONMENT):
            continue
        found = lookup_environment(variable.name)  # type: ignore[no-untyped-call]
        if found is not None:
            slots[variable.name] = serialize.dumps(found.consts)  # type: ignore[no-untyped-call]
    return slots


def _object_code(optimised: Any, wrapper: str) -> bytes:
    """The optimised code of a kernel as an object file in which only `wrapper` is seen from outside.

    The passes that decide what is computed have run already, as in a program that compiles: here nothing but code that
    nobody calls is removed.
    """
    import llvmlite.binding as llvm

    module = llvm.parse_bitcode(optimised.as_bitcode())
    for function in module.functions:
        if not function.is_declaration:
            function.linkage = "external" if function.name == wrapper else "internal"
    target = llvm.Target.from_triple(llvm.get_process_triple())
    machine = target.create_target_machine(cpu=cpu(), features="", opt=3, reloc="pic", codemodel="default")
    passes = llvm.create_new_module_pass_manager()
    passes.add_global_dead_code_eliminate_pass()
    passes.run(module, llvm.create_pass_builder(machine, llvm.PipelineTuningOptions(speed_level=3)))
    code: bytes = machine.emit_object(module)
    return code


def _manifest(entries: Sequence[Entry]) -> dict[str, Any]:
    """What the library tells of itself."""
    import llvmlite
    import numba

    kernels: dict[str, dict[str, Any]] = {}
    for number, entry in enumerate(entries):
        told = kernels.setdefault(
            name_of(entry.kernel), {"fingerprint": fingerprint(entry.kernel.plain), "entries": []}
        )
        told["entries"].append({"number": number, "arguments": entry.arguments})
    made_with = {"numba": numba.__version__, "llvmlite": llvmlite.__version__, "numpy": np.__version__}
    return {"environment": environment(), "cpu": cpu(), "made_with": made_with, "kernels": kernels}


def _table(entries: Sequence[Entry], manifest: dict[str, Any]) -> Iterator[str]:
    """Lines of C: symbols, constants and the manifest."""
    pickled = {symbol: data for entry in entries for symbol, data in entry.slots.items()}
    number_of = {symbol: number for number, symbol in enumerate(pickled)}
    for symbol, number in number_of.items():
        yield f'extern void *environment_{number} __asm__("{symbol}");'
        yield f"static const unsigned char pickled_{number}[] = {{{_bytes(pickled[symbol])}}};"
    for number, entry in enumerate(entries):
        yield f'extern PyObject *call_{number}(PyObject *, PyObject *, PyObject *) __asm__("{entry.wrapper}");'
        rows = (
            f"{{&environment_{number_of[one]}, pickled_{number_of[one]}, {len(pickled[one])}}}" for one in entry.slots
        )
        yield f"static const slot_t slots_{number}[] = {{{', '.join([*rows, '{NULL, NULL, 0}'])}}};"
    rows = (f"{{call_{number}, slots_{number}, {len(entry.slots)}}}" for number, entry in enumerate(entries))
    yield f"static const entry_t entries[] = {{{', '.join([*rows, '{NULL, NULL, 0}'])}}};"
    yield f"#define ENTRIES {len(entries)}"
    text = json.dumps(manifest, separators=(",", ":")).encode()
    yield f"static const unsigned char description[] = {{{_bytes(text)}}};"
    yield f"#define DESCRIPTION_BYTES {len(text)}"


def _try_compilers() -> None:
    """Compile and link an empty extension: before minutes of work, not after them.

    Raises:
        CannotBuild: no compiler, no headers of Python, or no libraries to link with.
    """
    cc, cxx = compilers()
    with tempfile.TemporaryDirectory(prefix="gnd-kernels-") as folder:
        for compiler, name in ((cxx, "empty.cpp"), (cc, "empty.c")):
            source = Path(folder) / name
            source.write_text(_EMPTY, encoding="ascii")
            include = f"-I{sysconfig.get_path('include')}"
            command = [*compiler, "-shared", "-fPIC", include, str(source), "-o", str(source.with_suffix(".so"))]
            done = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603 - on own files
            if done.returncode:
                said = [line for line in done.stderr.splitlines() if "error" in line or "cannot" in line]
                told = (said or done.stderr.splitlines() or [f"ended with {done.returncode}"])[0]
                raise CannotBuild(f"{shlex.join(compiler)} builds no extension of Python: {told.strip()}")


def _bytes(data: bytes) -> str:
    return ",".join(map(str, data))


def _linked(folder: Path, entries: Sequence[Entry], manifest: dict[str, Any]) -> Path:
    """Compile the C side and link all.

    Raises:
        CannotBuild: the compiler or the linker refuses.
    """
    from numba.pycc.cc import CC

    cc, cxx = compilers()
    numbas: Any = CC("_kernels", source_module=sys.modules[__name__])  # type: ignore[no-untyped-call]
    (folder / "table.h").write_text("\n".join(_table(entries, manifest)), encoding="ascii")
    (folder / "exported").write_text("{ global: PyInit__kernels; local: *; };", encoding="ascii")
    mixin, *others = numbas._get_mixin_sources()
    defines = [f"-D{name}={value}" for name, value in numbas._get_mixin_defines()]
    quoted = [f'-DPYCC_MIXIN="{mixin}"', f'-DGND_TABLE="{folder / "table.h"}"', *_of_cpu()]
    includes = [f"-I{sysconfig.get_path('include')}", f"-I{np.get_include()}"]
    objects = []
    for number, entry in enumerate(entries):
        objects.append(folder / f"kernel_{number}.o")
        objects[-1].write_bytes(entry.code)
    for source in (str(Path(__file__).with_name("kernels.c")), *others):
        compiler = cxx if source.endswith(".cpp") else cc
        objects.append(folder / f"{Path(source).stem}.o")
        _run([*compiler, *_C_FLAGS, *includes, *defines, *quoted, "-c", source, "-o", str(objects[-1])])
    linked = folder / "linked.so"
    shared = ["-shared", "-Wl,-Bsymbolic", "-Wl,--as-needed", "-Wl,-z,relro", "-s", "-pthread"]
    script = f"-Wl,--version-script={folder / 'exported'}"
    _run([*cc, *shared, script, *map(str, objects), "-lm", "-o", str(linked)])
    return linked


def _of_cpu() -> list[str]:
    return ["-DGND_X86_64_V3"] if cpu() == V3 else []


def _run(command: list[str]) -> None:
    done = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603 - a compiler, on own files
    if done.returncode:
        last = "\n".join(done.stderr.strip().splitlines()[-5:])
        raise CannotBuild(f"{command[0]} ended with {done.returncode}: {last}")


def build_environment(cache: Path) -> dict[str, str]:
    """Environment of the process that builds: numba compiles for the wanted processor, and finds nothing compiled."""
    return {
        **os.environ,
        VARIABLE: "numba",
        "NUMBA_CPU_NAME": cpu(),
        "NUMBA_CPU_FEATURES": "",
        "NUMBA_CACHE_DIR": str(cache),
    }


def main() -> None:
    """See the module's head; a line of JSON tells what was made."""
    path, *scenes = sys.argv[1:]
    try:
        print(json.dumps(build(Path(path), scenes or SCENES)))
    except (CannotBuild, UnfitLibrary) as error:
        sys.exit(f"gnd: {error}")


if __name__ == "__main__":
    main()
