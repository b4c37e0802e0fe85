"""Turn a kernel into machine code that C can call: the builder's side, with numba.

All that this package uses of numba's private names stands in `_emit_object`. The function that it
emits has numba's own calling convention, which `library.py` follows.
"""

from __future__ import annotations

import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pamctl.compiled import Substitution, make_inner_twin
from pamctl.compiled_ahead.library import SYMBOL, find_linker

_NEVER_CALLED = "void NRT_MemInfo_call_dtor(void *memory) { __builtin_trap(); }"
"""Code with arrays can give back memory of numba's. None is: its arrays are the caller's."""


class CannotBuild(Exception):
    """There is no machine code of a kernel; the message says why."""


def build_library(
    source: str,
    kernel: Callable[..., Any],
    names: dict[str, Any],
    pointers: str,
    path: Path,
    substitution: Substitution | None = None,
) -> None:
    """Build a shared library whose one function runs `source`.

    `source` defines a function `glue` of pointers, which calls the kernel by the name `kernel` and
    knows `names`. `pointers` tells its arguments: i for int64, d for double, b for bytes.
    The file appears complete or not at all. Raises `CannotBuild`.
    """
    linker = find_linker()
    if linker is None:
        raise CannotBuild("there is no C compiler to link with: install gcc")
    twin = make_inner_twin(kernel, substitution)
    scope = {**names, **_make_pointer_functions(), "kernel": twin}
    exec(compile(source, "<glue>", "exec"), scope)
    code, symbol = _emit_object(scope["glue"], pointers)
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=path.parent) as folder:
        part, library = Path(folder, "kernel.o"), Path(folder, "kernel.so")
        part.write_bytes(code)
        command = [
            *(linker, "-shared", "-o", str(library), str(part)),
            *(f"-Wl,--defsym={SYMBOL}={symbol}", "-Wl,--no-undefined", "-lm", "-xc", "-"),
        ]
        done = subprocess.run(
            command, input=_NEVER_CALLED, capture_output=True, text=True, check=False
        )
        if done.returncode:
            raise CannotBuild(f"{linker}: {done.stderr.strip()}")
        library.replace(path)


def _emit_object(glue: Callable[..., None], pointers: str) -> tuple[bytes, str]:
    """Return the object file of a function, and the function's symbol."""
    import llvmlite.binding as llvm
    import numba

    types: Any = numba.types
    njit: Any = numba.njit
    kinds = {"i": types.int64, "d": types.float64, "b": types.uint8}
    signature = types.void(*(types.CPointer(kinds[code]) for code in pointers))
    compiled = njit(
        signature, error_model="python", no_cpython_wrapper=True, no_cfunc_wrapper=True
    )(glue)
    (overload,) = compiled.overloads.values()
    machine = llvm.Target.from_default_triple().create_target_machine(
        opt=3,
        reloc="pic",
        codemodel="default",
        cpu=llvm.get_host_cpu_name(),
        features=llvm.get_host_cpu_features().flatten(),
    )
    module = overload.library._final_module
    return machine.emit_object(module), overload.fndesc.llvm_func_name


def _make_pointer_functions() -> dict[str, Any]:
    """Return functions that write a double, an int64 or a bool to any byte of a buffer, and the
    one that makes an array of a pointer.
    """
    import numba
    from llvmlite import ir
    from numba.extending import intrinsic

    types: Any = numba.types

    def make(wanted: Any, kind: Any) -> Any:
        @intrinsic
        def put(typing: Any, base: Any, offset: Any, value: Any) -> Any:
            def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
                pointer, at, number = arguments
                number = context.cast(builder, number, signature.args[2], wanted)
                if wanted is types.boolean:
                    number = builder.zext(number, kind)
                place = builder.bitcast(builder.gep(pointer, [at]), kind.as_pointer())
                builder.store(number, place, align=1)
                return context.get_dummy_value()

            return types.void(base, types.intp, value), generate

        return put

    module: Any = numba
    return {
        "carray": module.carray,
        "put_float": make(types.float64, ir.DoubleType()),
        "put_int": make(types.int64, ir.IntType(64)),
        "put_bool": make(types.boolean, ir.IntType(8)),
    }
