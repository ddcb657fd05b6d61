"""Parameters of kernels: arrays and numbers, single or grouped in structs that have one name in Python and C++.

A struct is a `NamedTuple` whose fields are annotated like parameters of a kernel. Python passes an instance, and C++
receives a `struct` of the same name with the same fields. So a kernel with thirty tensors has about ten parameters.
"""

import inspect
from collections.abc import Callable, Iterable, Iterator
from typing import Annotated, Any, NamedTuple, TypeAlias, get_args, get_origin, get_type_hints

import torch
from torch import Tensor


class ArrayKind(NamedTuple):
    """A contiguous tensor on the CPU, which a kernel sees as a pointer."""

    dtype: torch.dtype
    # Type of an element in C++: a number, or `struct` and the name of a record that the headers of the kernels define.
    element: str

    @property
    def cpp(self) -> str:
        """Type of the parameter in C++."""
        return f"{self.element}*"


# `Annotated[FloatArray, "n, 3"]` also declares the size, which `guard.Sizes` checks. A kernel reads an array and writes
# an output. The compiler refuses code that writes to an array.
FloatArray: TypeAlias = Annotated[Tensor, ArrayKind(torch.float32, "const float")]
IntArray: TypeAlias = Annotated[Tensor, ArrayKind(torch.int32, "const int")]
ByteArray: TypeAlias = Annotated[Tensor, ArrayKind(torch.uint8, "const unsigned char")]
FloatOutput: TypeAlias = Annotated[Tensor, ArrayKind(torch.float32, "float")]
IntOutput: TypeAlias = Annotated[Tensor, ArrayKind(torch.int32, "int")]
LongOutput: TypeAlias = Annotated[Tensor, ArrayKind(torch.int64, "long long")]

# Numbers have 32 bits in Warp and C++. Arrays travel to Warp as addresses, because describing arrays to Warp takes
# longer than some kernels run.
_NUMBERS = {int: "int", float: "float"}
_WARP = {int: "wp.int32", float: "wp.float32"}


class Field(NamedTuple):
    """An array or a number of a kernel."""

    path: str  # "n", or "camera.width" for a field of a struct
    kind: ArrayKind | type
    shape: str | None  # declared sizes of an array's dimensions

    @property
    def symbol(self) -> str:
        """Name of the Warp parameter that carries the field."""
        return self.path.replace(".", "_") + ("_address" if isinstance(self.kind, ArrayKind) else "")

    @property
    def warp(self) -> str:
        """Type of that Warp parameter."""
        return "wp.uint64" if isinstance(self.kind, ArrayKind) else _WARP[self.kind]

    @property
    def cpp(self) -> str:
        """Type of the field in C++."""
        return self.kind.cpp if isinstance(self.kind, ArrayKind) else _NUMBERS[self.kind]

    @property
    def value(self) -> str:
        """C++ expression that converts the Warp parameter to the field."""
        return f"({self.cpp}){self.symbol}"


class Parameter(NamedTuple):
    """A parameter of a kernel: a single field, or a struct of several fields."""

    name: str
    struct: type | None
    fields: tuple[Field, ...]

    @property
    def definition(self) -> str:
        """C++ code that defines the parameter from Warp's parameters."""
        if self.struct is None:
            (field,) = self.fields
            # A number needs no definition: it is Warp's parameter itself.
            return f"{field.cpp} const {self.name} = {field.value};\n" if field.symbol != self.name else ""
        values = ", ".join(field.value for field in self.fields)
        return f"const {self.struct.__name__} {self.name} = {{{values}}};\n"


def parameters_of(stub: Callable[..., Any]) -> tuple[Parameter, ...]:
    """Return the parameters that a stub declares."""
    hints = get_type_hints(stub, include_extras=True)
    return tuple(_parameter(name, hints[name]) for name in inspect.signature(stub).parameters)


def structs_of(parameters: tuple[Parameter, ...]) -> list[type]:
    """Return the structs among the parameters, each once."""
    return list(dict.fromkeys(p.struct for p in parameters if p.struct is not None))


def declare_struct(struct: type) -> str:
    """Return C++ code that declares a struct."""
    fields = "".join(
        f"    {field.cpp} {field.path};{f'  // [{field.shape}]' if field.shape else ''}\n"
        for field in _fields(struct, "")
    )
    return f"struct {struct.__name__} {{\n{fields}}};\n"


def group(parameters: tuple[Parameter, ...], values: Iterable[Any]) -> dict[str, Any]:
    """Rebuild the arguments of a call, by name, from the values of all fields in order."""
    following = iter(values)
    return {
        p.name: next(following) if p.struct is None else p.struct(*(next(following) for _ in p.fields))
        for p in parameters
    }


def call_reader(
    name: str, parameters: tuple[Parameter, ...], by_name: bool
) -> Callable[..., tuple[int | float, ...] | None]:
    """Make a function that turns the arguments of a call into one flat tuple of addresses and numbers.

    The function returns None if an argument or a field does not have the declared kind. Python itself checks the names.
    A launch takes a few microseconds, most of them here, so the function is generated code without loops or
    collections.

    Args:
        name: Name of the generated function, for error messages.
        parameters: Parameters of the generated function.
        by_name: Whether callers must name the arguments.
    """
    namespace: dict[str, Any] = {"SMALLEST": -(2**31), "LARGEST": 2**31 - 1}
    structs: list[str] = []
    unpacked: list[str] = []
    conditions: list[str] = []
    values: list[str] = []
    for parameter in parameters:
        fields = [parameter.name]
        if parameter.struct is not None:
            namespace[parameter.struct.__name__] = parameter.struct
            structs.append(f"type({parameter.name}) is {parameter.struct.__name__}")
            fields = [f"f{len(values) + i}" for i in range(len(parameter.fields))]
            unpacked.append(f"{', '.join(fields)}, = {parameter.name}")
        for given, field in zip(fields, parameter.fields, strict=True):
            i = len(values)
            if isinstance(field.kind, ArrayKind):
                namespace[f"dtype{i}"] = field.kind.dtype
                fits = f"{given}.dtype is dtype{i} and {given}.is_cpu and {given}.is_contiguous()"
                # A non-empty tensor without an address, such as a subclass's, keeps its numbers elsewhere.
                conditions.append(f"{fits} and ((a{i} := {given}.data_ptr()) or not {given}.numel())")
                values.append(f"a{i}")
            else:
                in_range = f" and SMALLEST <= {given} <= LARGEST" if field.kind is int else ""
                conditions.append(f"type({given}) is {field.kind.__name__}{in_range}")
                values.append(given)
    source = f"""def {name}({", ".join(["*"] * by_name + [p.name for p in parameters])}):
    if {" and ".join(structs) or True}:
        {"; ".join(unpacked) or "pass"}
        try:
            if {" and ".join(f"({condition})" for condition in conditions) or True}:
                return ({"".join(f"{value}, " for value in values)})
        except AttributeError:
            pass
    return None
"""
    exec(source, namespace)
    made: Callable[..., tuple[int | float, ...] | None] = namespace[name]
    return made


def _parameter(name: str, annotation: Any) -> Parameter:
    if isinstance(annotation, type) and issubclass(annotation, tuple):
        return Parameter(name, annotation, tuple(_fields(annotation, f"{name}.")))
    return Parameter(name, None, (_field(name, annotation),))


def _fields(struct: type, prefix: str) -> Iterator[Field]:
    for name, annotation in get_type_hints(struct, include_extras=True).items():
        yield _field(prefix + name, annotation)


def _field(path: str, annotation: Any) -> Field:
    if get_origin(annotation) is not Annotated:
        return Field(path, annotation, None)
    _, kind, *shape = get_args(annotation)
    return Field(path, kind, *shape or [None])
