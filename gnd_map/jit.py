"""The one way in which this project compiles a kernel: machine code made ahead of time, or numba on its first call."""

import inspect
from collections.abc import Callable
from functools import cache, update_wrapper
from importlib import import_module
from threading import RLock
from typing import Any, Final, TypeVar, cast

F = TypeVar("F", bound=Callable[..., Any])

_PLAIN: Final[dict[str, Any]] = {"cache": True, "error_model": "numpy", "nogil": True}
# numba's own name for it. A version without it would refuse it at the first call, not go on slower.
_BARE: Final[dict[str, Any]] = {**_PLAIN, "_nrt": False}
_PASTED: Final[dict[str, Any]] = {"inline": "always", "error_model": "numpy"}
# By name: this package knows no files, and is imported by what reads them.
_AHEAD: Final = "gnd.ahead.library"
_MAKING: Final = RLock()
_TELL: Final[list[Callable[[str], None]]] = []
_LOADED: Final[list[Callable[[], None]]] = []
_RECORD: Final[list[Callable[["LazyKernel", tuple[Any, ...]], None]]] = []
_KERNELS: Final[list["LazyKernel"]] = []
_OF: Final[dict[Callable[..., Any], "LazyKernel"]] = {}


def tell_compiling(tell: Callable[[str], None]) -> None:
    """Have `tell` called with the name of each kernel that is compiled in this process, before it is: the disk holds no
    machine code of it yet, and the first of them take seconds. Loads nothing.
    """
    _TELL.append(tell)


def when_numba_loads(do: Callable[[], None]) -> None:
    """Have `do` called once, when the first kernel of this process needs numba. Loads nothing."""
    _LOADED.append(do)


def record_calls(record: Callable[["LazyKernel", tuple[Any, ...]], None]) -> None:
    """Have `record` called with each kernel that Python calls from here on, and its arguments, before it runs.

    Before the first of these calls only: a dispatcher that has taken its kernel's place is not recorded.
    """
    _RECORD.append(record)


def kernel_of(function: Callable[..., Any]) -> "LazyKernel | None":
    """The kernel that was made of a plain function, None where it is none."""
    return _OF.get(function)


def kernels() -> tuple["LazyKernel", ...]:
    """The kernels in the modules that are imported."""
    return tuple(_KERNELS)


def kernels_ready() -> tuple[int, int]:
    """How many kernels have machine code in this process, compiled or from the disk, and how many there are in the
    modules that are imported; not every command needs all of them.
    """
    return sum(kernel.is_ready for kernel in _KERNELS), len(_KERNELS)


@cache
def _listen_once() -> None:
    """Register what is to be told with numba, which has just been loaded."""
    for do in _LOADED:
        do()
    if not _TELL:
        return
    from numba.core import event

    class Compiling(event.Listener):
        """Passes on which kernel is about to be compiled."""

        def on_start(self, begun: Any) -> None:
            for tell in _TELL:
                tell(begun.data["dispatcher"].__name__)

        def on_end(self, ended: Any) -> None:
            """Nothing is told of the end."""

    event.register("numba:compile", Compiling())  # type: ignore[no-untyped-call]  # numba has no types


class LazyKernel:
    """A kernel of which this process has no machine code yet. Who imports a module of kernels loads no numba.

    At the first call it asks the library that was compiled ahead of time (`gnd.ahead`); where that has none for it, or
    none for these types of arguments, numba compiles it. It stands for what it found everywhere: when it is called
    (some 0.2 µs more a call), when attributes are read (`signatures`, `py_func`), and as a global of other kernels,
    which numba asks for `_numba_type_`. In its own module what it found takes its place at the first call:
    `module.kernel(...)` costs nothing more from then on.
    """

    def __init__(self, function: Callable[..., Any], options: dict[str, Any]) -> None:
        update_wrapper(self, function)
        self._function, self._options = function, options
        self._called: Any = None
        self._ahead: Any = None
        self._dispatcher: Any = None
        _OF[function] = self
        if options is not _PASTED:
            _KERNELS.append(self)

    @property
    def plain(self) -> Callable[..., Any]:
        """The function as it stands in the source."""
        return self._function

    @property
    def py_func(self) -> Callable[..., Any]:
        """As `plain`, under numba's name for it."""
        return self._function

    @property
    def options(self) -> dict[str, Any]:
        """How numba is asked to compile it."""
        return self._options

    @property
    def is_ready(self) -> bool:
        """Whether there is machine code for some types of its arguments."""
        return self._ahead is not None or (self._dispatcher is not None and bool(self._dispatcher.signatures))

    @property
    def made_by(self) -> str:
        """Where the machine code in this process came from: "ahead", "numba", "both", or "" where there is none yet."""
        by_numba = self._dispatcher is not None and bool(self._dispatcher.signatures)
        if self._ahead is None:
            return "numba" if by_numba else ""
        return "both" if by_numba else "ahead"

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        """Call the compiled kernel."""
        called = self._called
        return (self._first() if called is None else called)(*arguments, **named)

    def _first(self) -> Any:
        """What is called, found at the first call: machine code made ahead of time, or numba's dispatcher."""
        with _MAKING:
            if _RECORD:
                return self._recorded
            if self._called is None and self._options is not _PASTED:
                self._ahead = import_module(_AHEAD).compiled_kernel(self)
                if self._ahead is not None:
                    self._take_place(self._ahead)
            return self.dispatcher if self._called is None else self._called

    def _recorded(self, *arguments: Any, **named: Any) -> Any:
        for record in _RECORD:
            record(self, self._positional(arguments, named))
        return self.dispatcher(*arguments, **named)

    def _positional(self, arguments: tuple[Any, ...], named: dict[str, Any]) -> tuple[Any, ...]:
        """All arguments of a call in their order, defaults included."""
        bound = inspect.signature(self._function).bind(*arguments, **named)
        bound.apply_defaults()
        return bound.args

    def otherwise(self, *arguments: Any, **named: Any) -> Any:
        """Call it where the library has nothing for a call as it was written: its arguments in order, or numba."""
        complete = self._positional(arguments, named)
        if named or len(complete) > len(arguments):
            return self._ahead(*complete)
        return self.dispatcher(*complete)

    def _take_place(self, called: Any) -> None:
        """Let what was found be called from now on, here and in the kernel's module."""
        self._called = called
        home = self._function.__globals__
        if home.get(self._function.__name__) is self:
            home[self._function.__name__] = called

    @property
    def dispatcher(self) -> Any:
        """The object of numba, made when it is first asked for."""
        if self._dispatcher is None:
            import numba  # here: it takes a second, and who only reads messages needs no kernel

            with _MAKING:
                if self._dispatcher is None:
                    _listen_once()
                    self._dispatcher = numba.njit(**self._options)(self._function)
                    if self._ahead is None and not _RECORD:
                        self._take_place(self._dispatcher)
        return self._dispatcher

    @property
    def _numba_type_(self) -> Any:
        return self.dispatcher._numba_type_

    def __getattr__(self, name: str) -> Any:
        """What the kernel itself has not is its dispatcher's."""
        if name.startswith("__") or name in _OWN:
            raise AttributeError(name)
        return getattr(self.dispatcher, name)


_OWN: Final = frozenset(("_dispatcher", "_function", "_options", "_called", "_ahead"))


def kernel(function: F) -> F:
    """Compile `function` with numba on its first call and keep the machine code on disk beside its module.

    Kernels run without the GIL: other threads go on. No fast-math: results must not depend on how a compiler orders
    sums. Division by zero gives inf or NaN, as in numpy.
    """
    return _lazy(function, _PLAIN)


def inlined(function: F) -> F:
    """As `kernel`, laid into its callers: for the few lines that run a hundred times a voxel."""
    return _lazy(function, {**_PLAIN, "forceinline": True})


def bare(function: F) -> F:
    """As `kernel`, for functions that make no arrays: those given to them are not counted as held, which takes two
    locked instructions an array and call, and most of the time where calls are short.
    """
    return _lazy(function, _BARE)


def bare_inlined(function: F) -> F:
    """As `bare`, laid into its callers: for the few lines that run a hundred times a voxel."""
    return _lazy(function, {**_BARE, "forceinline": True})


def pasted(function: F) -> F:
    """Laid into its callers before their types are known: for a part of a kernel that itself is no kernel."""
    return _lazy(function, _PASTED)


def _lazy(function: F, options: dict[str, Any]) -> F:
    return cast("F", LazyKernel(function, options))
