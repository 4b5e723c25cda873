"""The one way in which this project compiles a kernel: on its first call, and only then is numba loaded."""

from collections.abc import Callable
from functools import update_wrapper
from threading import Lock
from typing import Any, Final, TypeVar, cast

F = TypeVar("F", bound=Callable[..., Any])

_PLAIN: Final[dict[str, Any]] = {"cache": True, "error_model": "numpy", "nogil": True}
# numba's own name for it. A version without it would refuse it at the first call, not go on slower.
_BARE: Final[dict[str, Any]] = {**_PLAIN, "_nrt": False}
_PASTED: Final[dict[str, Any]] = {"inline": "always", "error_model": "numpy"}
_MAKING: Final = Lock()
_TELL: Final[list[Callable[[str], None]]] = []
_listening: Final[list[bool]] = []
_KERNELS: Final[list["LazyKernel"]] = []


def tell_compiling(tell: Callable[[str], None]) -> None:
    """Have `tell` called with the name of each kernel that is compiled in this process, before it is: the disk holds no
    machine code of it yet, and the first of them take seconds. Loads nothing.
    """
    _TELL.append(tell)


def kernels_ready() -> tuple[int, int]:
    """How many kernels have machine code in this process, compiled or from the disk, and how many there are in the
    modules that are imported; not every command needs all of them.
    """
    return sum(kernel.is_ready for kernel in _KERNELS), len(_KERNELS)


def kernel_functions() -> tuple[Callable[..., Any], ...]:
    """The plain functions of the kernels in the modules that are imported."""
    return tuple(kernel.plain for kernel in _KERNELS)


def _listen() -> None:
    """Register what is to be told with numba, which has just been loaded."""
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
    """A kernel that numba has not seen yet. Who imports a module of kernels and calls none of them loads no numba.

    It stands for its dispatcher everywhere: when it is called (some 0.6 µs more a call), when its attributes are read
    (`signatures`, `py_func`), and as a global of other kernels, which numba asks for `_numba_type_`. In its own module
    the dispatcher takes its place at the first call: `module.kernel(...)` costs nothing more from then on.
    """

    def __init__(self, function: Callable[..., Any], options: dict[str, Any]) -> None:
        update_wrapper(self, function)
        self._function, self._options = function, options
        self._dispatcher: Any = None
        if options is not _PASTED:
            _KERNELS.append(self)

    @property
    def plain(self) -> Callable[..., Any]:
        """The function as it stands in the source."""
        return self._function

    @property
    def is_ready(self) -> bool:
        """Whether there is machine code for some types of its arguments."""
        return self._dispatcher is not None and bool(self._dispatcher.signatures)

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        """Call the compiled kernel."""
        dispatcher = self._dispatcher
        return self.dispatcher(*arguments, **named) if dispatcher is None else dispatcher(*arguments, **named)

    @property
    def dispatcher(self) -> Any:
        """The object of numba, made when it is first asked for."""
        if self._dispatcher is None:
            import numba  # here: it takes a second, and who only reads messages needs no kernel

            with _MAKING:
                if self._dispatcher is None:
                    if _TELL and not _listening:
                        _listening.append(True)
                        _listen()
                    self._dispatcher = numba.njit(**self._options)(self._function)
                    home = self._function.__globals__
                    if home.get(self._function.__name__) is self:
                        home[self._function.__name__] = self._dispatcher
        return self._dispatcher

    @property
    def _numba_type_(self) -> Any:
        return self.dispatcher._numba_type_

    def __getattr__(self, name: str) -> Any:
        """What the kernel itself has not is its dispatcher's."""
        if name.startswith("__") or name in ("_dispatcher", "_function", "_options"):
            raise AttributeError(name)
        return getattr(self.dispatcher, name)


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
