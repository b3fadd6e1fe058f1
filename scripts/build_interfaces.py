"""Builds ROS 2 interface packages from .msg, .srv and .action files into this Python's environment.

For packages that are not to be had as wheels. Needs the ROS wheels of this environment (their rosidl
generators, headers and libraries) and a C and C++ compiler; no colcon, no CMake. For each package, in this
order: translate to .idl, describe and hash the types, generate C and Python, compile, install.
"""

from __future__ import annotations

import argparse
import concurrent.futures
import hashlib
import importlib.util
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

KINDS = ("msg", "srv", "action")
TYPE_SUPPORTS = (
    "rosidl_typesupport_c",
    "rosidl_typesupport_fastrtps_c",
    "rosidl_typesupport_introspection_c",
)
ENVIRONMENT = Path(sys.prefix)
_STAMP = "built_from.sha256"
_DEPENDENCY = re.compile(r"^\s*([a-z][a-z0-9_]*)/", re.MULTILINE)
_ALWAYS_NEEDED = {
    "srv": {"service_msgs"},
    "action": {"action_msgs", "service_msgs", "unique_identifier_msgs"},
}
_RUNTIME = ("rosidl_runtime_c", "rcutils", "rmw", "rosidl_typesupport_c")
_FASTRTPS = ("rosidl_typesupport_fastrtps_c", "rosidl_typesupport_fastrtps_cpp", "fastcdr")


class Unbuildable(Exception):
    """The package can't be built; the text says why."""


class Package(NamedTuple):
    """A folder named like the package, with msg/, srv/ and action/ in it."""

    name: str
    folder: Path
    files: list[Path]
    """Relative to the folder."""
    needs: list[str]
    """Other interface packages whose types are used."""


def read_package(folder: Path) -> Package:
    """:raises Unbuildable: there is no interface file"""
    folder = folder.resolve()
    files = sorted(path.relative_to(folder) for kind in KINDS for path in folder.glob(f"{kind}/*.{kind}"))
    if not files:
        raise Unbuildable(f"{folder} holds no msg/*.msg, srv/*.srv or action/*.action")
    needs: set[str] = set()
    for file in files:
        needs.update(_DEPENDENCY.findall((folder / file).read_text(encoding="utf-8")))
        needs.update(_ALWAYS_NEEDED.get(file.parts[0], set()))
    return Package(folder.name, folder, files, sorted(needs - {folder.name}))


def fingerprint(package: Package) -> str:
    """Changes with the definitions, this program, or the Python they are built for."""
    digest = hashlib.sha256(Path(__file__).read_bytes() + sys.version.encode())
    for file in package.files:
        digest.update(str(file).encode() + (package.folder / file).read_bytes())
    return digest.hexdigest()


# --- Generate --------------------------------------------------------------------------------------------


def to_idl(package: Package, share: Path) -> list[str]:
    """Translate all files; returns them in the form rosidl wants, ``root:relative``."""
    from rosidl_adapter.action import convert_action_to_idl
    from rosidl_adapter.msg import convert_msg_to_idl
    from rosidl_adapter.srv import convert_srv_to_idl

    convert = {"msg": convert_msg_to_idl, "srv": convert_srv_to_idl, "action": convert_action_to_idl}
    for file in package.files:
        kind = file.parts[0]
        (share / kind).mkdir(parents=True, exist_ok=True)
        shutil.copy(package.folder / file, share / kind)
        convert[kind](package.folder, package.name, file, share / kind)
    return [f"{share}:{file.with_suffix('.idl').as_posix()}" for file in package.files]


def generate(package: Package, share: Path, work: Path) -> None:
    """Write the sources of each generator into a folder of its own: two of them use the same file names."""
    from rosidl_generator_c.cli import GenerateC
    from rosidl_generator_py.cli import GeneratePython
    from rosidl_generator_type_description.cli import HashTypeDescription
    from rosidl_typesupport_c.cli import GenerateCTypesupport
    from rosidl_typesupport_fastrtps_c.cli import GenerateFastRTPSCTypesupport
    from rosidl_typesupport_introspection_c.cli import GenerateIntrospectionCTypesupport

    name, idl, include = package.name, to_idl(package, share), [str(ENVIRONMENT / "share")]
    HashTypeDescription("hash").generate_type_hashes(name, idl, include, share)
    for (
        file
    ) in idl:  # one at a time: rosidl pairs descriptions by stem, so srv/X and action/X would be mixed up
        root, _, relative = file.partition(":")
        described = [str(Path(root, relative).with_suffix(".json"))]
        GenerateC("c").generate(name, [file], include, work / "rosidl_generator_c" / name, described)
    others: dict[str, Any] = {
        "rosidl_generator_py": GeneratePython("py", typesupport_implementations=list(TYPE_SUPPORTS)),
        "rosidl_typesupport_c": GenerateCTypesupport(
            "c", typesupport_implementations=list(TYPE_SUPPORTS[1:])
        ),
        "rosidl_typesupport_fastrtps_c": GenerateFastRTPSCTypesupport("fastrtps_c"),
        "rosidl_typesupport_introspection_c": GenerateIntrospectionCTypesupport("introspection_c"),
    }
    for folder, generator in others.items():
        generator.generate(name, idl, include, work / folder / name)


# --- Compile ---------------------------------------------------------------------------------------------


class Compiler:
    """gcc and g++ with the include folders and libraries of the environment."""

    def __init__(self, package: Package, work: Path) -> None:
        self._package = package
        self._work = work
        folders = [work / folder for folder in ("rosidl_generator_c", *TYPE_SUPPORTS[1:])]
        folders += [path for path in (ENVIRONMENT / "include").iterdir() if path.is_dir()]
        folders += [ENVIRONMENT / "include"]  # fastcdr lies there directly
        folders += [Path(sysconfig.get_paths()["include"])]
        numpy = importlib.util.find_spec("numpy")
        if numpy is not None and numpy.submodule_search_locations:
            folders.append(Path(numpy.submodule_search_locations[0], "_core", "include"))
        self._includes = [f"-I{folder}" for folder in folders]

    def library(self, sources: Iterable[Path], target: Path, libraries: Iterable[str]) -> None:
        """Compile sources to one shared library; libraries that don't exist are left out.

        :raises Unbuildable: the compiler's message
        """
        sources = list(sources)
        objects = [self._work / f"{target.name}.{number}.o" for number, _ in enumerate(sources)]
        with concurrent.futures.ThreadPoolExecutor(os.cpu_count()) as pool:
            list(pool.map(self._compile, sources, objects))
        target.parent.mkdir(parents=True, exist_ok=True)
        search = [target.parent, self._work / "lib", ENVIRONMENT / "lib"]
        present = [
            name for name in libraries if any((folder / f"lib{name}.so").exists() for folder in search)
        ]
        _call(
            ["g++", "-shared", "-o", str(target), *map(str, objects), "-Wl,-rpath,$ORIGIN"]
            + [f"-L{folder}" for folder in search]
            + [f"-l{name}" for name in present]
        )

    def _compile(self, source: Path, target: Path) -> None:
        language = ["g++", "-std=c++17"] if source.suffix == ".cpp" else ["gcc", "-std=gnu11"]
        _call([*language, "-O1", "-fPIC", "-w", *self._includes, "-c", str(source), "-o", str(target)])


def compile_all(package: Package, work: Path) -> None:
    """The five libraries and three extension modules of an interface package."""
    compiler, name = Compiler(package, work), package.name
    lib = work / "lib"

    def built(part: str) -> Path:
        return lib / f"lib{name}__{part}.so"

    def of_needs(part: str) -> list[str]:
        return [f"{need}__{part}" for need in package.needs]

    def sources(folder: str) -> list[Path]:
        return [path for end in ("c", "cpp") for path in sorted((work / folder / name).glob(f"*/**/*.{end}"))]

    own_c = f"{name}__rosidl_generator_c"
    base = [*of_needs("rosidl_generator_c"), *_RUNTIME]
    compiler.library(sources("rosidl_generator_c"), built("rosidl_generator_c"), base)
    for support in reversed(TYPE_SUPPORTS):
        extra = _FASTRTPS if "fastrtps" in support else (support,)
        compiler.library(sources(support), built(support), [own_c, *of_needs(support), *base, *extra])
    supports = [f"{name}__{support}" for support in TYPE_SUPPORTS]
    python = f"{name}__rosidl_generator_py"
    compiler.library(
        sources("rosidl_generator_py"),
        built("rosidl_generator_py"),
        [own_c, supports[0], *of_needs("rosidl_generator_py"), *base],
    )
    for support in TYPE_SUPPORTS:
        module = work / "rosidl_generator_py" / name / f"_{name}_s.ep.{support}.c"
        compiler.library(
            [module], work / "python" / f"{name}_s__{support}.so", [python, own_c, *supports, *base]
        )


def _call(command: list[str]) -> None:
    try:
        subprocess.run(command, check=True, capture_output=True, text=True)
    except FileNotFoundError:
        raise Unbuildable(f"there is no {command[0]}; install a C and C++ compiler") from None
    except subprocess.CalledProcessError as error:
        raise Unbuildable(f"{command[0]} failed:\n{error.stderr}") from None


# --- Install ---------------------------------------------------------------------------------------------


def install(package: Package, share: Path, work: Path, prefix: Path) -> None:
    """Put everything where the ROS wheels put theirs."""
    name = package.name
    python = site_packages(prefix) / name
    shutil.rmtree(python, ignore_errors=True)
    shutil.copytree(work / "rosidl_generator_py" / name, python, ignore=shutil.ignore_patterns("*.c"))
    (python / "__init__.py").touch()
    for module in (work / "python").glob("*.so"):
        shutil.copy(module, python)
    (prefix / "lib").mkdir(exist_ok=True)
    for library in (work / "lib").glob("*.so"):
        shutil.copy(library, prefix / "lib")
    target = prefix / "share" / name
    shutil.rmtree(target, ignore_errors=True)
    shutil.copytree(share, target)
    index = prefix / "share" / "ament_index" / "resource_index"
    interfaces = [file.with_suffix(end).as_posix() for file in package.files for end in (file.suffix, ".idl")]
    for resource, text in (("packages", ""), ("rosidl_interfaces", "\n".join(sorted(interfaces)))):
        (index / resource).mkdir(parents=True, exist_ok=True)
        (index / resource / name).write_text(text, encoding="utf-8")
    # last, so that a build that was cut short is done again
    (target / _STAMP).write_text(fingerprint(package), encoding="utf-8")


def site_packages(prefix: Path) -> Path:
    """Where Python finds packages below a prefix."""
    return Path(sysconfig.get_path("platlib", vars={"platbase": str(prefix), "base": str(prefix)}))


def standing(package: Package, prefix: Path) -> str | None:
    """Why nothing need be built, or None."""
    stamp = prefix / "share" / package.name / _STAMP
    if stamp.exists():
        current = stamp.read_text(encoding="utf-8") == fingerprint(package)
        return f"{package.name} is up to date" if current else None
    if prefix == ENVIRONMENT and importlib.util.find_spec(package.name) is not None:
        return f"{package.name} is there already, from elsewhere"
    return None


def build(folder: Path, prefix: Path) -> str:
    """Build one package unless it stands; returns what was done, in words.

    :raises Unbuildable: no interface files, no generators, no compiler, or a compiler that refuses
    """
    package = read_package(folder)
    reason = standing(package, prefix)
    if reason is not None:
        return reason
    if importlib.util.find_spec("rosidl_generator_py") is None:
        raise Unbuildable("the rosidl generators are missing; install the extra 'ros' first")
    os.environ["AMENT_PREFIX_PATH"] = str(ENVIRONMENT)
    with tempfile.TemporaryDirectory() as scratch:
        work, share = Path(scratch, "work"), Path(scratch, "share", package.name)
        generate(package, share, work)
        compile_all(package, work)
        install(package, share, work, prefix)
    return f"{package.name} is built"


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "folders", nargs="+", type=Path, help="named like the package, with msg/, srv/, action/"
    )
    parser.add_argument(
        "--prefix", type=Path, default=ENVIRONMENT, help="where to install (this environment)"
    )
    options = parser.parse_args()
    try:
        for folder in options.folders:
            sys.stdout.write(build(folder, options.prefix.resolve()) + "\n")
    except Unbuildable as error:
        sys.exit(f"build_interfaces: {error}")


if __name__ == "__main__":
    main()
