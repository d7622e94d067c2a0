/* FMI 2.0 for co-simulation around controller.c, made by ccd-casadi. */
#include <stdlib.h>
#include <string.h>

#include "controller.h"

#if defined(_WIN32)
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif

#define GUID "@GUID@"
#define FORWARD CONTROLLER_ERRORS
#define OUTPUT (CONTROLLER_ERRORS + CONTROLLER_FORCES)
#define COUNT (CONTROLLER_ERRORS + 2 * CONTROLLER_FORCES)

typedef enum { fmi2OK, fmi2Warning, fmi2Discard, fmi2Error, fmi2Fatal, fmi2Pending } fmi2Status;
typedef void *fmi2Component;
typedef unsigned int fmi2ValueReference;
typedef int fmi2Boolean;

typedef struct {
    controller_state state;
    double values[COUNT]; /* e, f, u */
    double start;         /* s; a sample every CONTROLLER_PERIOD from here */
    double samples;       /* so far */
} instance;

EXPORT const char *fmi2GetTypesPlatform(void) { return "default"; }
EXPORT const char *fmi2GetVersion(void) { return "2.0"; }

EXPORT fmi2Status fmi2Reset(fmi2Component c)
{
    memset(c, 0, sizeof(instance));
    controller_reset(&((instance *)c)->state);
    return fmi2OK;
}

EXPORT fmi2Component fmi2Instantiate(const char *name, int type, const char *guid,
                                     const char *resources, const void *functions,
                                     fmi2Boolean visible, fmi2Boolean logging)
{
    instance *own;

    (void)name; (void)resources; (void)functions; (void)visible; (void)logging;
    if (type != 1 || guid == NULL || strcmp(guid, GUID) != 0) /* 1: co-simulation */
        return NULL;
    own = malloc(sizeof(instance));
    if (own != NULL)
        fmi2Reset(own);
    return own;
}

EXPORT void fmi2FreeInstance(fmi2Component c) { free(c); }

EXPORT fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean has_tolerance, double tolerance,
                                      double start, fmi2Boolean has_stop, double stop)
{
    (void)has_tolerance; (void)tolerance; (void)has_stop; (void)stop;
    ((instance *)c)->start = start;
    return fmi2OK;
}

EXPORT fmi2Status fmi2EnterInitializationMode(fmi2Component c) { (void)c; return fmi2OK; }
EXPORT fmi2Status fmi2ExitInitializationMode(fmi2Component c) { (void)c; return fmi2OK; }
EXPORT fmi2Status fmi2Terminate(fmi2Component c) { (void)c; return fmi2OK; }

EXPORT fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference which[], size_t count,
                              double values[])
{
    size_t i;

    for (i = 0; i < count; i++) {
        if (which[i] >= COUNT)
            return fmi2Error;
        values[i] = ((instance *)c)->values[which[i]];
    }
    return fmi2OK;
}

EXPORT fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference which[], size_t count,
                              const double values[])
{
    size_t i;

    for (i = 0; i < count; i++) {
        if (which[i] >= OUTPUT)
            return fmi2Error;
        ((instance *)c)->values[which[i]] = values[i];
    }
    return fmi2OK;
}

/* Every sample in [t, t + step), inputs as they are now; u stays until the next one. */
EXPORT fmi2Status fmi2DoStep(fmi2Component c, double t, double step, fmi2Boolean no_return)
{
    instance *own = c;
    const double end = t + step - 1e-6 * CONTROLLER_PERIOD; /* multiples of a period are rounded */

    (void)no_return;
    while (own->start + own->samples * CONTROLLER_PERIOD < end) {
        controller_step_forward(&own->state, own->values, own->values + FORWARD,
                                own->values + OUTPUT);
        own->samples += 1.0;
    }
    return fmi2OK;
}

/* What a controller of reals, without saved states and derivatives, has to have all the same. */
#define NONE(name, ...) \
    EXPORT fmi2Status name(fmi2Component c, __VA_ARGS__)
#define EMPTY(name, type) \
    NONE(name, const fmi2ValueReference *v, size_t n, type *x) \
    { (void)c; (void)v; (void)x; return n ? fmi2Error : fmi2OK; }
EMPTY(fmi2GetInteger, int)
EMPTY(fmi2SetInteger, const int)
EMPTY(fmi2GetBoolean, int)
EMPTY(fmi2SetBoolean, const int)
EMPTY(fmi2GetString, const char *)
EMPTY(fmi2SetString, const char *const)
#define REFUSED { (void)c; return fmi2Error; }
NONE(fmi2SetDebugLogging, fmi2Boolean on, size_t n, const char *const *k)
{ (void)c; (void)on; (void)n; (void)k; return fmi2OK; }
#pragma GCC diagnostic ignored "-Wunused-parameter"
NONE(fmi2GetFMUstate, void **state) REFUSED
NONE(fmi2SetFMUstate, void *state) REFUSED
NONE(fmi2FreeFMUstate, void **state) REFUSED
NONE(fmi2SerializedFMUstateSize, void *state, size_t *n) REFUSED
NONE(fmi2SerializeFMUstate, void *state, char *to, size_t n) REFUSED
NONE(fmi2DeSerializeFMUstate, const char *from, size_t n, void **state) REFUSED
NONE(fmi2GetDirectionalDerivative, const fmi2ValueReference *z, size_t n,
     const fmi2ValueReference *v, size_t m, const double *dv, double *dz) REFUSED
NONE(fmi2SetRealInputDerivatives, const fmi2ValueReference *v, size_t n, const int *order,
     const double *x) REFUSED
NONE(fmi2GetRealOutputDerivatives, const fmi2ValueReference *v, size_t n, const int *order,
     double *x) REFUSED
EXPORT fmi2Status fmi2CancelStep(fmi2Component c) REFUSED
NONE(fmi2GetStatus, int kind, fmi2Status *value) REFUSED
NONE(fmi2GetRealStatus, int kind, double *value) REFUSED
NONE(fmi2GetIntegerStatus, int kind, int *value) REFUSED
NONE(fmi2GetBooleanStatus, int kind, fmi2Boolean *value) REFUSED
NONE(fmi2GetStringStatus, int kind, const char **value) REFUSED
