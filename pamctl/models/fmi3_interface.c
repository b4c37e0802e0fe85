/* FMI 3.0 for co-simulation, over the plant of plant.c. Plain C99, no header but the C library's.

   One communication step holds the command and advances the plant, as the simulated rig does:
   in equal steps of at most 0.5 ms, cut where a delayed command arrives. */

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include "plant.c"

#ifdef _WIN32
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif

typedef enum { OK, WARNING, DISCARD, FAILED, FATAL } FmiStatus;
typedef uint32_t FmiReference;
typedef void (*FmiLog)(void *environment, FmiStatus status, const char *category, const char *message);

enum { WAITING_MOST = 4096 }; /* changes of the command that are on their way to the valve */

typedef struct {
    PLANT plant;
    double time_s;
    double now_s; /* since the start; the commands' own clock */
    double command_v;
    double written_s[WAITING_MOST];
    double written_v[WAITING_MOST];
    long long written;
    long long arrived;
} FmiModel;

typedef struct {
    FmiModel model;
    FmiLog log;
    void *environment;
} FmiInstance;

static void start_model(FmiModel *model) {
    memset(model, 0, sizeof *model);
    model->plant = start;
}

static FmiStatus fail(const FmiInstance *instance, const char *message) {
    if (instance->log) instance->log(instance->environment, FAILED, "logStatusError", message);
    return FAILED;
}

/* --- the plant ------------------------------------------------------------------------------ */

/* An error leaves the model as it is. Where Python would refuse the arithmetic, `failed` is set. */
static FmiStatus advance(FmiInstance *instance, double duration_s) {
    FmiModel *model = &instance->model;
    failed = 0;
#ifdef COMMAND_IS_DELAYED
    /* Forget what has arrived; write a command only where it changes. */
    memmove(model->written_s, model->written_s + model->arrived,
            (size_t)(model->written - model->arrived) * sizeof(double));
    memmove(model->written_v, model->written_v + model->arrived,
            (size_t)(model->written - model->arrived) * sizeof(double));
    model->written -= model->arrived;
    model->arrived = 0;
    long long written = model->written;
    if (!written || model->written_v[written - 1] != model->command_v) {
        if (written == WAITING_MOST)
            return fail(instance, "more than 4096 commands are on their way to the valve: "
                                  "use longer communication steps");
        model->written_s[written] = model->now_s;
        model->written_v[written++] = model->command_v;
    }
    const ADVANCED after = advance_plant(
        &model->plant, (Numbers){model->written_s, written}, (Numbers){model->written_v, written},
        model->arrived, model->now_s, duration_s);
    const PLANT plant = after.item_0;
#else
    const PLANT plant = advance_plant(&model->plant, model->command_v, duration_s);
#endif
    if (failed || !isfinite(plant.position_m) || !isfinite(plant.pressure_pa))
        return fail(instance, "the plant has left the range of its model");
    model->plant = plant;
#ifdef COMMAND_IS_DELAYED
    model->written = written;
    model->arrived = after.item_1;
#endif
    model->now_s += duration_s;
    return OK;
}

static bool read_variable(const FmiInstance *instance, FmiReference reference, double *value) {
    const FmiModel *model = &instance->model;
    const PLANT *plant = &model->plant;
    switch (reference) {
    case 0: *value = model->time_s; return true;
    case 1: *value = model->command_v; return true;
    case 2: *value = show_position_m(plant); return true;
    case 3: *value = show_pressure_pa(plant); return true;
    case 4: *value = plant->position_m; return true;
    case 5: *value = plant->velocity_m_per_s; return true;
    case 6: *value = plant->pressure_pa; return true;
    }
    if (reference < FIRST_NUMBER || reference - FIRST_NUMBER >= NUMBERS) return false;
    *value = numbers[reference - FIRST_NUMBER];
    return true;
}

/* --- life ------------------------------------------------------------------------------------ */

EXPORT const char *fmi3GetVersion(void) { return "3.0"; }

EXPORT void *fmi3InstantiateCoSimulation(
    const char *name, const char *token, const char *resources, bool visible, bool logging,
    bool events, bool early_return, const FmiReference intermediate[], size_t intermediate_count,
    void *environment, FmiLog log, void *update) {
    (void)name, (void)resources, (void)visible, (void)logging, (void)events, (void)early_return;
    (void)intermediate, (void)intermediate_count, (void)update;
    if (!token || strcmp(token, TOKEN)) {
        if (log)
            log(environment, FAILED, "logStatusError",
                "the instantiation token is not that of modelDescription.xml");
        return NULL;
    }
    FmiInstance *instance = malloc(sizeof *instance);
    if (!instance) return NULL;
    instance->log = log;
    instance->environment = environment;
    start_model(&instance->model);
    return instance;
}

EXPORT void *fmi3InstantiateModelExchange(void) { return NULL; }
EXPORT void *fmi3InstantiateScheduledExecution(void) { return NULL; }
EXPORT void fmi3FreeInstance(void *instance) { free(instance); }

EXPORT FmiStatus fmi3EnterInitializationMode(FmiInstance *instance, bool with_tolerance, double tolerance,
                                          double start_s, bool with_stop, double stop_s) {
    (void)with_tolerance, (void)tolerance, (void)with_stop, (void)stop_s;
    instance->model.time_s = start_s;
    return OK;
}

EXPORT FmiStatus fmi3ExitInitializationMode(FmiInstance *instance) { (void)instance; return OK; }
EXPORT FmiStatus fmi3Terminate(FmiInstance *instance) { (void)instance; return OK; }

EXPORT FmiStatus fmi3Reset(FmiInstance *instance) {
    start_model(&instance->model);
    return OK;
}

EXPORT FmiStatus fmi3SetDebugLogging(FmiInstance *instance, bool on, size_t count,
                                  const char *const names[]) {
    (void)instance, (void)on, (void)count, (void)names;
    return OK;
}

EXPORT FmiStatus fmi3DoStep(FmiInstance *instance, double time_s, double step_s, bool no_earlier_state,
                         bool *event, bool *terminate, bool *early, double *reached_s) {
    (void)no_earlier_state;
    *event = *terminate = *early = false;
    *reached_s = time_s;
    if (!(step_s > 0.0) || !isfinite(step_s))
        return fail(instance, "the communication step must be longer than 0 s");
    const FmiStatus status = advance(instance, step_s);
    if (status == OK) instance->model.time_s = *reached_s = time_s + step_s;
    return status;
}

/* --- variables -------------------------------------------------------------------------------- */

EXPORT FmiStatus fmi3GetFloat64(FmiInstance *instance, const FmiReference references[], size_t count,
                             double values[], size_t value_count) {
    if (count != value_count) return fail(instance, "one value belongs to each reference");
    failed = 0;
    for (size_t i = 0; i < count; i++)
        if (!read_variable(instance, references[i], &values[i]))
            return fail(instance, "there is no variable of this value reference");
    return failed ? fail(instance, "a sensor has left the range of its model") : OK;
}

EXPORT FmiStatus fmi3SetFloat64(FmiInstance *instance, const FmiReference references[], size_t count,
                             const double values[], size_t value_count) {
    if (count != value_count) return fail(instance, "one value belongs to each reference");
    for (size_t i = 0; i < count; i++) {
        if (references[i] != 1) return fail(instance, "only command_v can be set");
        if (!isfinite(values[i])) return fail(instance, "command_v must be a finite number");
    }
    if (count) instance->model.command_v = values[count - 1];
    return OK;
}

/* No variable has another type. */
#define NO_VARIABLES(Name, type)                                                              \
    EXPORT FmiStatus fmi3Get##Name(FmiInstance *instance, const FmiReference references[],             \
                                size_t count, type values[], size_t value_count) {            \
        (void)references, (void)values, (void)value_count;                                    \
        return count ? fail(instance, "there is no variable of this type") : OK;              \
    }                                                                                         \
    EXPORT FmiStatus fmi3Set##Name(FmiInstance *instance, const FmiReference references[],             \
                                size_t count, const type values[], size_t value_count) {      \
        (void)references, (void)values, (void)value_count;                                    \
        return count ? fail(instance, "there is no variable of this type") : OK;              \
    }
NO_VARIABLES(Float32, float)
NO_VARIABLES(Int8, int8_t)
NO_VARIABLES(UInt8, uint8_t)
NO_VARIABLES(Int16, int16_t)
NO_VARIABLES(UInt16, uint16_t)
NO_VARIABLES(Int32, int32_t)
NO_VARIABLES(UInt32, uint32_t)
NO_VARIABLES(Int64, int64_t)
NO_VARIABLES(UInt64, uint64_t)
NO_VARIABLES(Boolean, bool)
NO_VARIABLES(String, char *)

/* --- state: all of it is one struct without pointers ------------------------------------------- */

EXPORT FmiStatus fmi3GetFMUState(FmiInstance *instance, void **state) {
    if (!*state) *state = malloc(sizeof(FmiModel));
    if (!*state) return fail(instance, "there is no memory for the state");
    memcpy(*state, &instance->model, sizeof(FmiModel));
    return OK;
}

EXPORT FmiStatus fmi3SetFMUState(FmiInstance *instance, const void *state) {
    memcpy(&instance->model, state, sizeof(FmiModel));
    return OK;
}

EXPORT FmiStatus fmi3FreeFMUState(FmiInstance *instance, void **state) {
    (void)instance;
    free(*state);
    *state = NULL;
    return OK;
}

EXPORT FmiStatus fmi3SerializedFMUStateSize(FmiInstance *instance, void *state, size_t *size) {
    (void)instance, (void)state;
    *size = sizeof(FmiModel);
    return OK;
}

EXPORT FmiStatus fmi3SerializeFMUState(FmiInstance *instance, const void *state, uint8_t bytes[],
                                    size_t size) {
    if (size != sizeof(FmiModel)) return fail(instance, "the serialized state has another size");
    memcpy(bytes, state, size);
    return OK;
}

EXPORT FmiStatus fmi3DeserializeFMUState(FmiInstance *instance, const uint8_t bytes[], size_t size,
                                      void **state) {
    if (size != sizeof(FmiModel)) return fail(instance, "the serialized state has another size");
    if (!*state) *state = malloc(size);
    if (!*state) return fail(instance, "there is no memory for the state");
    memcpy(*state, bytes, size);
    return OK;
}

/* --- what this unit does not offer, as modelDescription.xml says ------------------------------- */

#define NOT_OFFERED(name)                                             \
    EXPORT FmiStatus name(FmiInstance *instance) {                          \
        return fail(instance, #name " is not offered by this unit"); \
    }
NOT_OFFERED(fmi3GetBinary)
NOT_OFFERED(fmi3SetBinary)
NOT_OFFERED(fmi3GetClock)
NOT_OFFERED(fmi3SetClock)
NOT_OFFERED(fmi3GetNumberOfVariableDependencies)
NOT_OFFERED(fmi3GetVariableDependencies)
NOT_OFFERED(fmi3GetDirectionalDerivative)
NOT_OFFERED(fmi3GetAdjointDerivative)
NOT_OFFERED(fmi3EnterConfigurationMode)
NOT_OFFERED(fmi3ExitConfigurationMode)
NOT_OFFERED(fmi3GetIntervalDecimal)
NOT_OFFERED(fmi3GetIntervalFraction)
NOT_OFFERED(fmi3GetShiftDecimal)
NOT_OFFERED(fmi3GetShiftFraction)
NOT_OFFERED(fmi3SetIntervalDecimal)
NOT_OFFERED(fmi3SetIntervalFraction)
NOT_OFFERED(fmi3SetShiftDecimal)
NOT_OFFERED(fmi3SetShiftFraction)
NOT_OFFERED(fmi3EvaluateDiscreteStates)
NOT_OFFERED(fmi3UpdateDiscreteStates)
NOT_OFFERED(fmi3EnterEventMode)
NOT_OFFERED(fmi3EnterStepMode)
NOT_OFFERED(fmi3EnterContinuousTimeMode)
NOT_OFFERED(fmi3CompletedIntegratorStep)
NOT_OFFERED(fmi3SetTime)
NOT_OFFERED(fmi3SetContinuousStates)
NOT_OFFERED(fmi3GetContinuousStateDerivatives)
NOT_OFFERED(fmi3GetEventIndicators)
NOT_OFFERED(fmi3GetContinuousStates)
NOT_OFFERED(fmi3GetNominalsOfContinuousStates)
NOT_OFFERED(fmi3GetNumberOfEventIndicators)
NOT_OFFERED(fmi3GetNumberOfContinuousStates)
NOT_OFFERED(fmi3GetOutputDerivatives)
NOT_OFFERED(fmi3ActivateModelPartition)
