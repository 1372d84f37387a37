"""Build an FMU that drives as the level-0 VUT, with FMI 2.0 or 3.0, for tests and the benchmark.

`python tools/build_fmu.py level0.fmu [2.0|3.0] [number|boolean]`. With the last word, the FMU has
an output `merge` of this type, which requests the merge from 50 m before M on. The script needs a C
compiler, gcc or g++.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path

C = r"""
#include <math.h>
#include <stdbool.h>
#include <stdlib.h>
typedef struct { double v[8]; int steps; } Unit;
static int get(Unit* u, const unsigned* r, size_t n, double* out) {
    for (size_t i = 0; i < n; i++) out[i] = u->v[r[i]];
    return 0;
}
static int set(Unit* u, const unsigned* r, size_t n, const double* in) {
    for (size_t i = 0; i < n; i++) u->v[r[i]] = in[i];
    return 0;
}
static int step(Unit* u) {
    u->steps++;
    if (u->steps == 4 && u->v[1] > 30.0) { FAULT }
    u->v[4] = fmin(fmax((28.0 - u->v[3]) / 0.1, 0.0), 1.0);
    u->v[5] = u->v[2] >= -50.0 ? 1.0 : 0.0;
    u->v[6] = u->v[3] + 0.1 * u->v[4];
    return 0;
}
static int clear(Unit* u) { Unit none = {{0}, 0}; *u = none; return 0; }
void* fmi2Instantiate(const char* a, int b, const char* c, const char* d, const void* e, int f,
                      int g) { return calloc(1, sizeof(Unit)); }
int fmi2SetupExperiment(Unit* u, int a, double b, double c, int d, double e) { return 0; }
int fmi2EnterInitializationMode(Unit* u) { return 0; }
int fmi2ExitInitializationMode(Unit* u) { return 0; }
int fmi2SetReal(Unit* u, const unsigned* r, size_t n, const double* v) { return set(u, r, n, v); }
int fmi2SetInteger(Unit* u, const unsigned* r, size_t n, const int* v) {
    for (size_t i = 0; i < n; i++) u->v[r[i]] = v[i];
    return 0;
}
int fmi2GetReal(Unit* u, const unsigned* r, size_t n, double* v) { return get(u, r, n, v); }
int fmi2GetBoolean(Unit* u, const unsigned* r, size_t n, int* v) {
    for (size_t i = 0; i < n; i++) v[i] = u->v[r[i]] != 0.0;
    return 0;
}
int fmi2DoStep(Unit* u, double t, double h, int a) { return step(u); }
int fmi2Reset(Unit* u) { return clear(u); }
int fmi2Terminate(Unit* u) { return 0; }
void fmi2FreeInstance(Unit* u) { free(u); }
void* fmi3InstantiateCoSimulation(const char* a, const char* b, const char* c, bool d, bool e,
    bool f, bool g, const unsigned* h, size_t i, void* j, void* k, void* l) {
    return calloc(1, sizeof(Unit));
}
int fmi3EnterInitializationMode(Unit* u, bool a, double b, double c, bool d, double e) { return 0; }
int fmi3ExitInitializationMode(Unit* u) { return 0; }
int fmi3SetFloat64(Unit* u, const unsigned* r, size_t n, const double* v, size_t m) {
    return set(u, r, n, v);
}
int fmi3SetFloat32(Unit* u, const unsigned* r, size_t n, const float* v, size_t m) {
    for (size_t i = 0; i < n; i++) u->v[r[i]] = v[i];
    return 0;
}
int fmi3SetInt64(Unit* u, const unsigned* r, size_t n, const long long* v, size_t m) {
    for (size_t i = 0; i < n; i++) u->v[r[i]] = v[i];
    return 0;
}
int fmi3GetFloat64(Unit* u, const unsigned* r, size_t n, double* v, size_t m) {
    return get(u, r, n, v);
}
int fmi3GetFloat32(Unit* u, const unsigned* r, size_t n, float* v, size_t m) {
    for (size_t i = 0; i < n; i++) v[i] = u->v[r[i]];
    return 0;
}
int fmi3GetBoolean(Unit* u, const unsigned* r, size_t n, bool* v, size_t m) {
    for (size_t i = 0; i < n; i++) v[i] = u->v[r[i]] != 0.0;
    return 0;
}
int fmi3DoStep(Unit* u, double t, double h, bool a, bool* b, bool* c, bool* d, double* e) {
    *b = *c = *d = false;
    *e = t + h;
    return step(u);
}
int fmi3Reset(Unit* u) { return clear(u); }
int fmi3Terminate(Unit* u) { return 0; }
void fmi3FreeInstance(Unit* u) { free(u); }
"""
NAMES = ("x_pov_m", "v_pov_mps", "x_vut_m", "v_vut_mps", "acceleration_mps2")


TYPES = {
    "number": ("Real", "Float64"),
    "single": ("Real", "Float32"),
    "boolean": ("Boolean", "Boolean"),
    "integer": ("Integer", "Int64"),
}
"""Types of variables, by FMI 2.0 and 3.0."""
MORE = {"merge": (5, "output"), "v_mps": (6, "output"), "seed": (7, "parameter")}
"""References and causalities of variables that a unit may have besides."""


def description(version: str, names: Sequence[str], of: str, more: Mapping[str, str]) -> str:
    """Return the modelDescription.xml of four inputs, an output, and more variables by type."""
    second = version == "2.0"
    causalities = dict(zip(names, ["input"] * 4 + ["output"], strict=True))
    listed = [(name, i, c, of) for i, (name, c) in enumerate(causalities.items())]
    listed += [(name, *MORE[name], kind) for name, kind in more.items()]
    variables, outputs = "", ""
    for index, (name, reference, causality, kind) in enumerate(listed, start=1):
        tag = TYPES[kind][not second]
        start = "" if causality == "output" else ' start="0"'
        continuous = causality != "parameter" and kind in ("number", "single")
        variability = "continuous" if continuous else "discrete"
        variability = "fixed" if causality == "parameter" else variability
        head = f'name="{name}" valueReference="{reference}" causality="{causality}"'
        head += f' variability="{variability}"'
        variables += (
            f"<ScalarVariable {head}><{tag}{start}/></ScalarVariable>"
            if second
            else f"<{tag} {head}{start}/>"
        )
        if causality == "output":
            of_2, of_3 = f'<Unknown index="{index}"/>', f'<Output valueReference="{reference}"/>'
            outputs += of_2 if second else of_3
    if second:
        return (
            '<fmiModelDescription fmiVersion="2.0" modelName="vut" guid="{vut}">'
            f'<CoSimulation modelIdentifier="vut"/><ModelVariables>{variables}</ModelVariables>'
            f"<ModelStructure><Outputs>{outputs}</Outputs></ModelStructure>"
            "</fmiModelDescription>"
        )
    return (
        '<fmiModelDescription fmiVersion="3.0" modelName="vut" instantiationToken="{vut}">'
        '<CoSimulation modelIdentifier="vut"/><ModelVariables>'
        '<Float64 name="time" valueReference="9" causality="independent" '
        'variability="continuous"/>'
        f"{variables}</ModelVariables><ModelStructure>{outputs}</ModelStructure>"
        "</fmiModelDescription>"
    )


def _stubs() -> str:
    """Return the functions that FMPy insists on and that this unit has no use for."""
    from fmpy.fmi2 import FMU2Slave
    from fmpy.fmi3 import FMU3Slave

    named = {name for unit in (FMU2Slave, FMU3Slave) for name in dir(unit) if name[:3] == "fmi"}
    missing = sorted(name for name in named if f" {name}(" not in C and f"*{name}(" not in C)
    return "".join(f"int {name}(void) {{ return 3; }}\n" for name in missing)


def compiler() -> str | None:
    """Return the path of a C compiler, if there is one."""
    return shutil.which("gcc") or shutil.which("g++")


def build_fmu(
    path: Path,
    version: str = "2.0",
    names: Sequence[str] = NAMES,
    fault: str = "",
    kind: str = "number",
    **more: str,
) -> Path:
    """Write the FMU; `fault` is C that runs in the fourth step of an episode with v_POV > 30.

    `kind` is the type of state and acceleration. `more` has the types of further variables, as
    `merge="boolean"`. Types are names of `TYPES`.
    """
    found = compiler()
    if found is None:
        raise RuntimeError("gcc is not on the PATH")
    with tempfile.TemporaryDirectory() as folder:
        source, library = Path(folder) / "vut.c", Path(folder) / "vut.so"
        source.write_text(C.replace("FAULT", fault) + _stubs())
        subprocess.run(
            [found, "-shared", "-fPIC", "-w", "-o", str(library), str(source), "-lm"], check=True
        )
        with zipfile.ZipFile(path, "x") as archive:
            archive.writestr("modelDescription.xml", description(version, names, kind, more))
            binaries = "linux64" if version == "2.0" else "x86_64-linux"
            archive.write(library, f"binaries/{binaries}/vut.so")
    return path


if __name__ == "__main__":
    file, fmi, kind = [*sys.argv[1:], *("", "2.0", "")[len(sys.argv) - 1 :]]
    print(build_fmu(Path(file), fmi, **({"merge": kind} if kind else {})))
