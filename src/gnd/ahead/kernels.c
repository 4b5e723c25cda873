/* The C side of a library of kernels: finds the machine code for the types of a call's arguments, and calls it.

   Compiled by gnd.ahead.build together with a table that it writes (GND_TABLE), with numba's own helpers, and linked
   with the object files of the kernels. What numba does in a process of its own at load time is done here in
   `init`; the constants of a kernel (its "environment") are unpickled when that kernel is first asked for, so that
   no module is imported for kernels that nobody calls. */

#define numba_unpickle numba_unpickle_each_time
#include PYCC_MIXIN /* numba/pycc/modulemixin.c: helpers, NRT, and init functions */
#undef numba_unpickle
#include <numpy/arrayscalars.h>

/* ---- constants -------------------------------------------------------------------------------------------------- */

/* Wrappers unpickle the classes of what they return at each call. numba remembers them by address and digest when it
   compiles in a process; its helpers for libraries do not, which takes 4 us a call. The GIL is held here. */

#define REMEMBERED 1024

static struct {
    const char *data;
    char digest[20];
    PyObject *value;
} remembered[REMEMBERED];

VISIBILITY_HIDDEN PyObject *
numba_unpickle(const char *data, int bytes, const char *digest)
{
    size_t i, first = ((size_t)data >> 3) % REMEMBERED;
    PyObject *value;
    for (i = first; remembered[i].data != NULL; i = (i + 1) % REMEMBERED) {
        if (digest != NULL && remembered[i].data == data && memcmp(remembered[i].digest, digest, 20) == 0) {
            Py_INCREF(remembered[i].value);
            return remembered[i].value;
        }
        if ((i + 1) % REMEMBERED == first)
            break;
    }
    value = numba_unpickle_each_time(data, bytes, digest);
    if (value != NULL && digest != NULL) {
        for (i = first; remembered[i].data != NULL; i = (i + 1) % REMEMBERED) /* unpickling may have come here, too */
            if ((i + 1) % REMEMBERED == first)
                return value;
        memcpy(remembered[i].digest, digest, 20);
        Py_INCREF(value);
        remembered[i].value = value;
        remembered[i].data = data;
    }
    return value;
}

/* ---- what the table is made of ---------------------------------------------------------------------------------- */

typedef struct {
    void **variable; /* where the machine code looks for its environment */
    const unsigned char *pickled;
    int bytes;
} slot_t;

typedef struct {
    PyCFunctionWithKeywords call; /* numba's wrapper: unboxes, releases the GIL, calls, boxes */
    const slot_t *slots;
    int count;
} entry_t;

#include GND_TABLE /* static const entry_t entries[]; ENTRIES; static const unsigned char description[]; */

/* ---- types of arguments ----------------------------------------------------------------------------------------- */

typedef struct spec {
    char what;      /* A array, i int64, d float64, b boolean, s another numpy scalar, T tuple, N named tuple */
    char kind;      /* of an array: f, i, u, b */
    char layout;    /* of an array: C, F, A (neither) */
    char writeable; /* of an array */
    int itemsize, ndim;
    PyTypeObject *type; /* of s and N; borrowed for ever: types of modules */
    Py_ssize_t count;   /* of T and N */
    struct spec *parts;
} spec_t;

static int
is_array(const spec_t *spec, PyObject *given)
{
    PyArrayObject *array = (PyArrayObject *)given;
    PyArray_Descr *descr;
    int c_order, f_order;
    if (!PyArray_CheckExact(given) || PyArray_NDIM(array) != spec->ndim)
        return 0;
    descr = PyArray_DESCR(array);
    if (descr->kind != spec->kind || PyArray_ITEMSIZE(array) != spec->itemsize || !PyArray_ISNOTSWAPPED(array))
        return 0;
    if (!PyArray_ISALIGNED(array) || !PyArray_ISWRITEABLE(array) != !spec->writeable)
        return 0;
    c_order = PyArray_IS_C_CONTIGUOUS(array);
    f_order = PyArray_IS_F_CONTIGUOUS(array);
    return spec->layout == 'C' ? c_order : spec->layout == 'F' ? f_order && !c_order : !c_order && !f_order;
}

static int
fits_int64(PyObject *given)
{
    int overflow;
    (void)PyLong_AsLongLongAndOverflow(given, &overflow);
    return !overflow;
}

static int
matches(const spec_t *spec, PyObject *given)
{
    PyTypeObject *type = Py_TYPE(given);
    Py_ssize_t i;
    switch (spec->what) {
    case 'A':
        return is_array(spec, given);
    case 'i':
        return (PyLong_CheckExact(given) && fits_int64(given)) || type == &PyInt64ArrType_Type;
    case 'd':
        return PyFloat_CheckExact(given) || type == &PyFloat64ArrType_Type;
    case 'b':
        return PyBool_Check(given) || type == &PyBoolArrType_Type;
    case 's':
        return type == spec->type;
    case 'T':
    case 'N':
        if (spec->what == 'T' ? !PyTuple_CheckExact(given) : type != spec->type)
            return 0;
        if (PyTuple_GET_SIZE(given) != spec->count)
            return 0;
        for (i = 0; i < spec->count; i++)
            if (!matches(&spec->parts[i], PyTuple_GET_ITEM(given, i)))
                return 0;
        return 1;
    }
    return 0;
}

static void
free_parts(spec_t *parts, Py_ssize_t count)
{
    Py_ssize_t i;
    if (parts == NULL)
        return;
    for (i = 0; i < count; i++)
        free_parts(parts[i].parts, parts[i].count);
    PyMem_Free(parts);
}

static spec_t *read_specs(PyObject *given, Py_ssize_t *count);

/* (what, kind, layout, writeable, itemsize, ndim, type or None, (parts)) */
static int
read_spec(PyObject *given, spec_t *spec)
{
    const char *what, *kind, *layout;
    PyObject *type, *parts;
    int writeable;
    if (!PyTuple_Check(given)
        || !PyArg_ParseTuple(given, "ssspiiOO", &what, &kind, &layout, &writeable, &spec->itemsize, &spec->ndim,
                             &type, &parts))
        return -1;
    spec->what = what[0];
    spec->kind = kind[0];
    spec->layout = layout[0];
    spec->writeable = (char)writeable;
    if (strchr("sN", spec->what) != NULL) {
        if (!PyType_Check(type) || (spec->what == 'N' && !PyType_IsSubtype((PyTypeObject *)type, &PyTuple_Type))) {
            PyErr_SetString(PyExc_TypeError, "not the type of a scalar or of a named tuple");
            return -1;
        }
        Py_INCREF(type);
        spec->type = (PyTypeObject *)type;
    }
    spec->parts = read_specs(parts, &spec->count);
    return spec->parts == NULL ? -1 : 0;
}

static spec_t *
read_specs(PyObject *given, Py_ssize_t *count)
{
    Py_ssize_t i, size;
    spec_t *specs;
    if (!PyTuple_Check(given)) {
        PyErr_SetString(PyExc_TypeError, "types of arguments are a tuple");
        return NULL;
    }
    size = PyTuple_GET_SIZE(given);
    specs = PyMem_Calloc(size + 1, sizeof(spec_t));
    if (specs == NULL)
        return (spec_t *)PyErr_NoMemory();
    for (i = 0; i < size; i++)
        if (read_spec(PyTuple_GET_ITEM(given, i), &specs[i]) < 0) {
            free_parts(specs, size);
            return NULL;
        }
    *count = size;
    return specs;
}

/* ---- a kernel --------------------------------------------------------------------------------------------------- */

typedef struct {
    const entry_t *entry;
    spec_t *specs;
    Py_ssize_t count;
    int number;
    Py_ssize_t calls;
} overload_t;

typedef struct {
    PyObject_HEAD
    PyObject *kernel;    /* whose attributes are ours */
    PyObject *otherwise; /* called where no overload matches */
    overload_t *overloads;
    Py_ssize_t count;
} Kernel;

static int
activate(const entry_t *entry, PyObject *module)
{
    int i;
    for (i = 0; i < entry->count; i++) {
        const slot_t *slot = &entry->slots[i];
        env_def_t env = {(const char *)slot->pickled, slot->bytes, NULL, NULL, 0};
        if (*slot->variable == NULL && (*slot->variable = recreate_environment(module, env)) == NULL)
            return -1;
    }
    return 0;
}

static void
kernel_dealloc(Kernel *self)
{
    Py_ssize_t i;
    for (i = 0; self->overloads != NULL && i < self->count; i++)
        free_parts(self->overloads[i].specs, self->overloads[i].count);
    PyMem_Free(self->overloads);
    Py_XDECREF(self->kernel);
    Py_XDECREF(self->otherwise);
    Py_TYPE(self)->tp_free((PyObject *)self);
}

static PyObject *
kernel_call(Kernel *self, PyObject *args, PyObject *named)
{
    Py_ssize_t i, k, given = PyTuple_GET_SIZE(args);
    for (i = 0; (named == NULL || PyDict_GET_SIZE(named) == 0) && i < self->count; i++) {
        overload_t *overload = &self->overloads[i];
        if (overload->count != given)
            continue;
        for (k = 0; k < given && matches(&overload->specs[k], PyTuple_GET_ITEM(args, k)); k++)
            ;
        if (k == given) {
            overload->calls++;
            return overload->entry->call(NULL, args, NULL);
        }
    }
    return PyObject_Call(self->otherwise, args, named);
}

static PyObject *
kernel_getattr(Kernel *self, PyObject *name)
{
    PyObject *found = PyObject_GenericGetAttr((PyObject *)self, name);
    if (found != NULL || !PyErr_ExceptionMatches(PyExc_AttributeError))
        return found;
    PyErr_Clear();
    return PyObject_GetAttr(self->kernel, name);
}

static PyObject *
kernel_calls(Kernel *self, void *unused)
{
    Py_ssize_t i;
    PyObject *calls = PyDict_New();
    for (i = 0; calls != NULL && i < self->count; i++) {
        PyObject *key = PyLong_FromLong(self->overloads[i].number);
        PyObject *value = PyLong_FromSsize_t(self->overloads[i].calls);
        if (key == NULL || value == NULL || PyDict_SetItem(calls, key, value) < 0)
            Py_CLEAR(calls);
        Py_XDECREF(key);
        Py_XDECREF(value);
    }
    return calls;
}

static PyGetSetDef kernel_getset[] = {
    {"calls_ahead", (getter)kernel_calls, NULL, "By number of entry: how often it was called.", NULL},
    {NULL, NULL, NULL, NULL, NULL},
};

static PyTypeObject Kernel_Type = {
    PyVarObject_HEAD_INIT(NULL, 0)
    .tp_name = "gnd.ahead.CompiledKernel",
    .tp_basicsize = sizeof(Kernel),
    .tp_dealloc = (destructor)kernel_dealloc,
    .tp_call = (ternaryfunc)kernel_call,
    .tp_getattro = (getattrofunc)kernel_getattr,
    .tp_getset = kernel_getset,
    .tp_flags = Py_TPFLAGS_DEFAULT,
};

/* ---- the module ------------------------------------------------------------------------------------------------- */

static int
read_overload(PyObject *given, overload_t *overload, PyObject *module)
{
    PyObject *specs;
    if (!PyTuple_Check(given) || !PyArg_ParseTuple(given, "iO", &overload->number, &specs))
        return -1;
    if (overload->number < 0 || overload->number >= ENTRIES) {
        PyErr_Format(PyExc_ValueError, "entry %d of %d", overload->number, ENTRIES);
        return -1;
    }
    overload->entry = &entries[overload->number];
    overload->specs = read_specs(specs, &overload->count);
    return overload->specs == NULL ? -1 : activate(overload->entry, module);
}

static PyObject *
make_kernel(PyObject *module, PyObject *args)
{
    PyObject *kernel, *otherwise, *overloads;
    Py_ssize_t i, count;
    Kernel *made;
    if (!PyArg_ParseTuple(args, "OOO!", &kernel, &otherwise, &PyTuple_Type, &overloads))
        return NULL;
    made = PyObject_New(Kernel, &Kernel_Type);
    if (made == NULL)
        return NULL;
    count = PyTuple_GET_SIZE(overloads);
    Py_INCREF(kernel);
    Py_INCREF(otherwise);
    made->kernel = kernel;
    made->otherwise = otherwise;
    made->count = count;
    made->overloads = PyMem_Calloc(count + 1, sizeof(overload_t));
    if (made->overloads == NULL) {
        Py_DECREF(made);
        return PyErr_NoMemory();
    }
    for (i = 0; i < count; i++)
        if (read_overload(PyTuple_GET_ITEM(overloads, i), &made->overloads[i], module) < 0) {
            Py_DECREF(made);
            return NULL;
        }
    return (PyObject *)made;
}

static PyObject *
describe(PyObject *module, PyObject *unused)
{
    return PyBytes_FromStringAndSize((const char *)description, DESCRIPTION_BYTES);
}

/* Whether this processor has what the kernels were compiled for; this file itself asks for nothing special. */
static PyObject *
runs_here(PyObject *module, PyObject *unused)
{
#if defined(GND_X86_64_V3)
    __builtin_cpu_init();
    return PyBool_FromLong(__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma")
                           && __builtin_cpu_supports("bmi") && __builtin_cpu_supports("bmi2")
                           && __builtin_cpu_supports("f16c") && __builtin_cpu_supports("lzcnt")
                           && __builtin_cpu_supports("movbe"));
#else
    Py_RETURN_TRUE;
#endif
}

static PyMethodDef methods[] = {
    {"describe", describe, METH_NOARGS, "JSON of what the library holds."},
    {"runs_here", runs_here, METH_NOARGS, "Whether this processor can run it."},
    {"make_kernel", make_kernel, METH_VARARGS, "Make the callable of a kernel: kernel, otherwise, overloads."},
    {NULL, NULL, 0, NULL},
};

static struct PyModuleDef definition = {PyModuleDef_HEAD_INIT, "_kernels", NULL, -1, methods, NULL, NULL, NULL, NULL};

static int
init_numba(PyObject *module)
{
    _numba_hashsecret_siphash_k0 = _Py_HashSecret.siphash.k0;
    _numba_hashsecret_siphash_k1 = _Py_HashSecret.siphash.k1;
    _numba_hashsecret_djbx33a_suffix = _Py_HashSecret.djbx33a.suffix;
    if (!init_numpy() || init_dynfunc_module(module))
        return -1;
    numba_rnd_ensure_global_init();
    NRT_MemSys_init();
    return init_nrt_python_module(module) ? -1 : 0;
}

PyMODINIT_FUNC
PyInit__kernels(void)
{
    PyObject *module = PyModule_Create(&definition);
    if (module == NULL)
        return NULL;
    if (init_numba(module) < 0 || PyType_Ready(&Kernel_Type) < 0) {
        Py_DECREF(module);
        return NULL;
    }
    return module;
}
