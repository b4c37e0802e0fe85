/* A stand-in for NI-DAQmx: as much of its C interface as the nidaqmx package calls for one
   analog input, two analog outputs and two encoder counters, on demand or as hardware-timed
   single points on the input's sample clock.

   It encodes a reading of NI's documents, not a measurement: it proves nothing about a real
   card. Numbers and signatures are held against the installed package by a test, which reads
   the prototypes and the enums of this file. One channel a task. */
#include "device.h"

#include <math.h>
#include <pthread.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#define EXPORT __attribute__((visibility("default")))

typedef void *TaskHandle;
typedef uint32_t bool32;
typedef double float64; /* of an array */

/* Names as in nidaqmx.error_codes.DAQmxErrors. */
enum {
    PAL_RESOURCE_RESERVED = -50103,
    INVALID_ATTRIBUTE_VALUE = -200077,
    MIN_NOT_LESS_THAN_MAX = -200082,
    INVALID_TASK = -200088,
    DUPLICATE_TASK = -200089,
    PHYSICAL_CHAN_DOES_NOT_EXIST = -200170,
    ATTR_NOT_SUPPORTED = -200197,
    INVALID_DEVICE_ID = -200220,
    BUFFER_TOO_SMALL_FOR_STRING = -200228,
    WRITE_BUFFER_TOO_SMALL = -200234,
    EXT_SAMP_CLK_SRC_NOT_SPECIFIED = -200303,
    CAN_NOT_PERFORM_OP_WHEN_NO_CHANS_IN_TASK = -200478,
    CAN_NOT_PERFORM_OP_WHILE_TASK_RUNNING = -200479,
    INVALID_AO_DATA_WRITE = -200561,
    HW_TIMED_SINGLE_POINT_AO_AND_DATA_XFER_NOT_PROG_IO = -200769,
    CTR_HW_TIMED_SINGLE_POINT_AND_DATA_XFER_NOT_PROG_IO = -200842,
    CANNOT_WRITE_WHEN_AUTO_START_FALSE_AND_TASK_NOT_RUNNING = -200846,
    HW_TIMED_SINGLE_POINT_AND_DATA_XFER_NOT_PROG_IO = -200996,
    DEV_CANNOT_BE_ACCESSED = -201003,
};

/* Names as in nidaqmx.constants, the class before the double underscore. */
enum {
    AcquisitionType__FINITE = 10178,
    AcquisitionType__HW_TIMED_SINGLE_POINT = 12522,
    BusType__PCI = 12582,
    BusType__USB = 12586,
    ChannelType__ANALOG_INPUT = 10100,
    ChannelType__ANALOG_OUTPUT = 10102,
    ChannelType__COUNTER_INPUT = 10131,
    DataTransferActiveTransferMode__DMA = 10054,
    DataTransferActiveTransferMode__INTERRUPT = 10204,
    DataTransferActiveTransferMode__POLLED = 10264,
    EncoderType__X_1 = 10090,
    EncoderType__X_2 = 10091,
    EncoderType__X_4 = 10092,
    LengthUnits__METERS = 10219,
    LengthUnits__TICKS = 10304,
    ProductCategory__M_SERIES_DAQ = 14643,
    TaskMode__TASK_START = 0,
    TaskMode__TASK_STOP = 1,
    TaskMode__TASK_VERIFY = 2,
    TaskMode__TASK_COMMIT = 3,
    TaskMode__TASK_RESERVE = 4,
    TaskMode__TASK_UNRESERVE = 5,
    TaskMode__TASK_ABORT = 6,
    TerminalConfiguration__DEFAULT = -1,
    TerminalConfiguration__DIFF = 10106,
    TerminalConfiguration__NRSE = 10078,
    TerminalConfiguration__RSE = 10083,
    VoltageUnits__VOLTS = 10348,
    WaitMode__POLL = 12524,
    WaitMode__SLEEP = 12547,
    WaitMode__WAIT_FOR_INTERRUPT = 12523,
    WaitMode__YIELD = 12525,
};

typedef struct Task {
    struct Task *next;
    int64_t id;
    char name[64];
    char channel[64];
    char physical[32];
    int32_t type; /* a ChannelType; 0 without a channel */
    Resource resource;
    bool is_running;
    int64_t period_ns; /* of the sample clock; 0: on demand */
    bool is_finite;    /* a buffer is filled from the start on, and read when it is full */
    int64_t start_ns;
    double start_v; /* of AO 0 */
    double lowest, highest; /* of the channel, V */
    double full_scale_v;
    int32_t terminal;
    int32_t transfer;  /* a DataTransferActiveTransferMode */
    int32_t wait_mode; /* a WaitMode */
    int32_t decoding;
    int32_t units;
    double metres_per_pulse;
    double initial_position;
    double filter_s[2]; /* of inputs A and B */
    bool32 filter_is_on[2];
    bool32 z_resets;
    int pfi[2]; /* the PFI lines of inputs A and B */
} Task;

static Task *tasks;
static int64_t last_task_id;
static char last_channel[64];
static __thread int32_t last_error;
static __thread char last_detail[512]; /* the lines below the message; empty for most errors */

/* --- entering and leaving a call --- */

static int32_t outcome(int32_t code)
{
    if (code < 0)
        last_error = code;
    return code;
}

static int32_t enter(const char *function, double timeout_s)
{
    last_detail[0] = 0;
    if (!device_attach())
        return outcome(INVALID_DEVICE_ID);
    int32_t fault = outcome(device_fault(function, timeout_s));
    if (fault >= 0)
        device_lock();
    return fault;
}

static int32_t leave(int32_t code, int32_t warning)
{
    device_unlock();
    return outcome(code ? code : warning);
}

/* Run `work` under the lock, unless a fault is due. */
#define CALL(timeout_s, work)                                                                      \
    do {                                                                                           \
        int32_t fault = enter(__func__, timeout_s);                                                \
        return fault < 0 ? fault : leave(work, fault);                                             \
    } while (0)

static Task *task_of(TaskHandle handle)
{
    Task *task = tasks;
    while (task && task != handle)
        task = task->next;
    return task;
}

/* In NI's form: the property, what was asked of it, and what it offers. */
static int32_t refuse_value(const Task *task, const char *property, const char *requested,
                            const char *offered)
{
    snprintf(last_detail, sizeof last_detail,
             "Property: %s\nRequested Value: %s\nYou Can Select: %s\n\nTask Name: %s\n\n", property,
             requested, offered, task->name);
    return INVALID_ATTRIBUTE_VALUE;
}

/* --- text and arrays: asked with no room, a getter says how much it needs --- */

static int32_t put_text(const char *text, char *buffer, uint32_t size)
{
    uint32_t needed = (uint32_t)strlen(text) + 1;
    if (size == 0)
        return (int32_t)needed;
    if (size < needed)
        return BUFFER_TOO_SMALL_FOR_STRING;
    memcpy(buffer, text, needed);
    return 0;
}

static int32_t put_doubles(const double *values, uint32_t count, double *buffer, uint32_t size)
{
    if (size == 0)
        return (int32_t)count;
    if (size < count)
        return WRITE_BUFFER_TOO_SMALL;
    memcpy(buffer, values, count * sizeof *values);
    return 0;
}

static int32_t list_channels(const char *kind, int count, char *buffer, uint32_t size)
{
    char list[512] = "";
    for (int i = 0, used = 0; i < count; i++)
        used += snprintf(list + used, sizeof list - (size_t)used, "%s%s/%s%d", i ? ", " : "",
                         device_attach()->name, kind, i);
    return put_text(list, buffer, size);
}

/* --- threads of its own, as a driver library may start them --- */

static void *idle(void *nothing)
{
    for (;;)
        pause();
    return nothing;
}

/* How many: STANDIN_THREADS, or four. They inherit what the calling thread is bound to. */
static void start_idle_threads(void)
{
    const char *wanted = getenv("STANDIN_THREADS");
    for (int count = wanted ? atoi(wanted) : 4; count > 0; count--) {
        pthread_t thread;
        if (pthread_create(&thread, NULL, idle, NULL) == 0)
            pthread_detach(thread);
    }
}

static pthread_once_t idle_threads = PTHREAD_ONCE_INIT;

/* --- tasks --- */

static int32_t create_task(const char *name, TaskHandle *handle)
{
    for (Task *other = tasks; other; other = other->next)
        if (*name && strcmp(other->name, name) == 0)
            return DUPLICATE_TASK;
    Task *task = calloc(1, sizeof *task);
    task->id = ++last_task_id;
    task->transfer = DataTransferActiveTransferMode__DMA;
    task->wait_mode = WaitMode__POLL;
    snprintf(task->name, sizeof task->name, "%s", name);
    if (!*name)
        snprintf(task->name, sizeof task->name, "_unnamedTask<%d>", (int)task->id);
    task->next = tasks;
    tasks = task;
    *handle = task;
    return 0;
}

EXPORT int32_t DAQmxCreateTask(const char *name, TaskHandle *handle)
{
    pthread_once(&idle_threads, start_idle_threads);
    CALL(0.0, create_task(name, handle));
}

static int64_t edges_per_count(const Task *task)
{
    return task->decoding == EncoderType__X_4 ? 1 : task->decoding == EncoderType__X_2 ? 2 : 4;
}

static double counter_resolution(const Task *task)
{
    return task->metres_per_pulse * (double)edges_per_count(task) / 4.0;
}

static int32_t reserve(Task *task)
{
    if (!task)
        return INVALID_TASK;
    if (!task->type)
        return CAN_NOT_PERFORM_OP_WHEN_NO_CHANS_IN_TASK;
    if (device_attach()->is_gone)
        return DEV_CANNOT_BE_ACCESSED;
    return device_reserve(task->resource, task->id) ? 0 : PAL_RESOURCE_RESERVED;
}

/* 1 as wired, -1 with A and B crossed, 0 where the encoder is on other lines. */
static int wired_sign(const Task *task)
{
    const int64_t *line = device_attach()->encoder_pfi;
    return task->pfi[0] == line[0] && task->pfi[1] == line[1]   ? 1
           : task->pfi[0] == line[1] && task->pfi[1] == line[0] ? -1
                                                                : 0;
}

static void start_counter(const Task *task)
{
    bool in_ticks = task->units == LengthUnits__TICKS;
    double per_count = in_ticks ? 1.0 : counter_resolution(task);
    double filter_s = fmax(task->filter_is_on[0] ? task->filter_s[0] : 0.0,
                           task->filter_is_on[1] ? task->filter_s[1] : 0.0);
    int sign = wired_sign(task);
    counter_start((int64_t)(task->initial_position / per_count),
                  (sign ? sign : 1) * edges_per_count(task), filter_s, task->z_resets);
    device_attach()->counter_runs = sign != 0;
}

/* Single points are read and written by the processor itself: programmed I/O. */
static int32_t check_transfer(const Task *task)
{
    if (!task->period_ns || task->is_finite || task->transfer == DataTransferActiveTransferMode__POLLED)
        return 0;
    switch (task->type) {
    case ChannelType__ANALOG_OUTPUT:
        return HW_TIMED_SINGLE_POINT_AO_AND_DATA_XFER_NOT_PROG_IO;
    case ChannelType__COUNTER_INPUT:
        return CTR_HW_TIMED_SINGLE_POINT_AND_DATA_XFER_NOT_PROG_IO;
    default:
        return HW_TIMED_SINGLE_POINT_AND_DATA_XFER_NOT_PROG_IO;
    }
}

static int32_t start(Task *task)
{
    int32_t code = reserve(task);
    if (code || task->is_running)
        return code;
    code = check_transfer(task);
    if (code)
        return code;
    task->is_running = true;
    device_note_move(task->resource, true);
    task->start_ns = device_now_ns();
    task->start_v = device_attach()->ao_v[0];
    if (task->resource == RESOURCE_AO0)
        device_glitch();
    if (task->resource == RESOURCE_CTR0)
        start_counter(task);
    if (task->resource == RESOURCE_AI) {
        device_attach()->ai_terminal = task->terminal;
        device_attach()->ai_full_scale_v = task->full_scale_v;
        device_attach()->ai_wait_mode = task->wait_mode;
        if (task->period_ns && !task->is_finite)
            clock_start(task->period_ns);
    }
    return 0;
}

static int32_t unreserve(Task *task)
{
    if (!task)
        return INVALID_TASK;
    if (task->is_running) {
        device_note_move(task->resource, false);
        if (task->resource == RESOURCE_CTR0)
            device_attach()->counter_runs = 0;
        if (task->resource == RESOURCE_AI && task->period_ns && !task->is_finite)
            clock_stop();
    }
    /* An analog output keeps the voltage it has. */
    task->is_running = false;
    device_release(task->resource, task->id);
    return 0;
}

static int32_t clear(Task *task)
{
    int32_t code = unreserve(task);
    for (Task **link = &tasks; *link; link = &(*link)->next)
        if (*link == task) {
            *link = task->next;
            free(task);
            break;
        }
    return code;
}

static int32_t control(Task *task, int32_t action)
{
    switch (action) {
    case TaskMode__TASK_START:
        return start(task);
    case TaskMode__TASK_COMMIT:
    case TaskMode__TASK_RESERVE:
        return reserve(task);
    case TaskMode__TASK_STOP:
    case TaskMode__TASK_UNRESERVE:
    case TaskMode__TASK_ABORT:
        return unreserve(task);
    case TaskMode__TASK_VERIFY:
        return !task ? INVALID_TASK : task->type ? 0 : CAN_NOT_PERFORM_OP_WHEN_NO_CHANS_IN_TASK;
    default:
        return INVALID_ATTRIBUTE_VALUE;
    }
}

EXPORT int32_t DAQmxStartTask(TaskHandle handle) { CALL(0.0, start(task_of(handle))); }

EXPORT int32_t DAQmxStopTask(TaskHandle handle) { CALL(0.0, unreserve(task_of(handle))); }

EXPORT int32_t DAQmxClearTask(TaskHandle handle) { CALL(0.0, clear(task_of(handle))); }

EXPORT int32_t DAQmxTaskControl(TaskHandle handle, int32_t action)
{
    CALL(0.0, control(task_of(handle), action));
}

static int32_t tell_whether_done(const Task *task, bool32 *is_done)
{
    if (!task)
        return INVALID_TASK;
    *is_done = !task->is_running;
    return 0;
}

EXPORT int32_t DAQmxIsTaskDone(TaskHandle handle, bool32 *is_done)
{
    CALL(0.0, tell_whether_done(task_of(handle), is_done));
}

/* --- channels --- */

/* The number of a physical channel such as "Dev1/ai3", or an error. */
static int32_t number_of(const char *physical, const char *kind, int count)
{
    const char *name = device_attach()->name;
    size_t device = strlen(name), letters = strlen(kind);
    if (strncmp(physical, name, device) != 0 || physical[device] != '/')
        return INVALID_DEVICE_ID;
    const char *channel = physical + device + 1;
    char *end = "?";
    long number = -1;
    if (strncmp(channel, kind, letters) == 0)
        number = strtol(channel + letters, &end, 10);
    return *end || number < 0 || number >= count ? PHYSICAL_CHAN_DOES_NOT_EXIST : (int32_t)number;
}

static int32_t add_channel(Task *task, const char *physical, const char *name, int32_t type)
{
    if (!task)
        return INVALID_TASK;
    if (task->type)
        return INVALID_ATTRIBUTE_VALUE;
    task->type = type;
    snprintf(task->physical, sizeof task->physical, "%s", physical);
    snprintf(task->channel, sizeof task->channel, "%s", *name ? name : physical);
    snprintf(last_channel, sizeof last_channel, "%s", task->channel);
    return 0;
}

static int32_t set_range(Task *task, double lowest, double highest)
{
    if (!(lowest < highest))
        return MIN_NOT_LESS_THAN_MAX;
    if (lowest < -10.0 || highest > 10.0)
        return INVALID_ATTRIBUTE_VALUE;
    if (!task)
        return INVALID_TASK;
    task->lowest = lowest;
    task->highest = highest;
    return 0;
}

static const double INPUT_RANGES_V[] = {0.2, 1.0, 5.0, 10.0};

static double narrowest_range_v(double lowest, double highest)
{
    double widest = fmax(fabs(lowest), fabs(highest));
    int i = 0;
    while (INPUT_RANGES_V[i] < widest)
        i++;
    return INPUT_RANGES_V[i];
}

static bool is_terminal(int32_t terminal)
{
    return terminal == TerminalConfiguration__DEFAULT || terminal == TerminalConfiguration__RSE ||
           terminal == TerminalConfiguration__NRSE || terminal == TerminalConfiguration__DIFF;
}

static int32_t create_ai(Task *task, const char *physical, const char *name, int32_t terminal,
                         double lowest, double highest, int32_t units)
{
    int32_t number = number_of(physical, "ai", AI_CHANNELS);
    int32_t code = number < 0 ? number : set_range(task, lowest, highest);
    if (code)
        return code;
    if (!is_terminal(terminal) || units != VoltageUnits__VOLTS)
        return INVALID_ATTRIBUTE_VALUE;
    task->resource = RESOURCE_AI;
    /* What an M Series card makes of "default". */
    task->terminal =
        terminal == TerminalConfiguration__DEFAULT ? TerminalConfiguration__DIFF : terminal;
    task->full_scale_v = narrowest_range_v(lowest, highest);
    return add_channel(task, physical, name, ChannelType__ANALOG_INPUT);
}

EXPORT int32_t DAQmxCreateAIVoltageChan(TaskHandle handle, const char *physical, const char *name,
                                        int32_t terminal, double lowest, double highest,
                                        int32_t units, const char *scale)
{
    (void)scale;
    CALL(0.0, create_ai(task_of(handle), physical, name, terminal, lowest, highest, units));
}

static int32_t create_ao(Task *task, const char *physical, const char *name, double lowest,
                         double highest, int32_t units)
{
    int32_t number = number_of(physical, "ao", AO_CHANNELS);
    int32_t code = number < 0 ? number : set_range(task, lowest, highest);
    if (code)
        return code;
    if (units != VoltageUnits__VOLTS)
        return INVALID_ATTRIBUTE_VALUE;
    task->resource = RESOURCE_AO0 + (Resource)number;
    return add_channel(task, physical, name, ChannelType__ANALOG_OUTPUT);
}

EXPORT int32_t DAQmxCreateAOVoltageChan(TaskHandle handle, const char *physical, const char *name,
                                        double lowest, double highest, int32_t units,
                                        const char *scale)
{
    (void)scale;
    CALL(0.0, create_ao(task_of(handle), physical, name, lowest, highest, units));
}

static int32_t create_encoder(Task *task, const char *physical, const char *name, int32_t decoding,
                              bool32 z_resets, int32_t units, double per_pulse, double initial)
{
    int32_t number = number_of(physical, "ctr", COUNTERS);
    if (number < 0)
        return number;
    if (!task)
        return INVALID_TASK;
    if (decoding < EncoderType__X_1 || decoding > EncoderType__X_4 || !(per_pulse > 0.0) ||
        (units != LengthUnits__METERS && units != LengthUnits__TICKS))
        return INVALID_ATTRIBUTE_VALUE;
    task->resource = RESOURCE_CTR0 + (Resource)number;
    task->decoding = decoding;
    task->z_resets = z_resets;
    /* What the two connector variants route to a counter by themselves. */
    static const int DEFAULTS[2][COUNTERS][2] = {{{8, 10}, {3, 11}}, {{0, 2}, {3, 5}}};
    memcpy(task->pfi, DEFAULTS[device_attach()->has_37_pins][number], sizeof task->pfi);
    task->units = units;
    task->metres_per_pulse = per_pulse;
    task->initial_position = initial;
    return add_channel(task, physical, name, ChannelType__COUNTER_INPUT);
}

EXPORT int32_t DAQmxCreateCILinEncoderChan(TaskHandle handle, const char *counter, const char *name,
                                           int32_t decoding, bool32 z_resets, double z_value,
                                           int32_t z_phase, int32_t units, double per_pulse,
                                           double initial, const char *scale)
{
    (void)z_value, (void)z_phase, (void)scale;
    CALL(0.0, create_encoder(task_of(handle), counter, name, decoding, z_resets, units, per_pulse,
                             initial));
}

EXPORT int32_t DAQmxInternalGetLastCreatedChan(char *buffer, uint32_t size)
{
    CALL(0.0, put_text(last_channel, buffer, size));
}

/* --- timing --- */

static int32_t clock_task(Task *task, const char *source, double rate_hz, int32_t mode)
{
    if (!task)
        return INVALID_TASK;
    if (!task->type)
        return CAN_NOT_PERFORM_OP_WHEN_NO_CHANS_IN_TASK;
    if (task->is_running)
        return CAN_NOT_PERFORM_OP_WHILE_TASK_RUNNING;
    bool is_master = task->resource == RESOURCE_AI;
    char clock[64];
    snprintf(clock, sizeof clock, "/%s/ai/SampleClock", device_attach()->name);
    if (!is_master && !*source) /* a counter has no clock of its own */
        return EXT_SAMP_CLK_SRC_NOT_SPECIFIED;
    if (mode == AcquisitionType__FINITE && is_master && rate_hz > 0.0 && rate_hz <= 250e3) {
        task->is_finite = true;
        task->period_ns = (int64_t)llround(1e9 / rate_hz);
        return 0;
    }
    if (device_attach()->bus == BusType__USB)
        return refuse_value(task, "DAQmx_SampQuant_SampMode", "DAQmx_Val_HWTimedSinglePoint",
                            "DAQmx_Val_FiniteSamps, DAQmx_Val_ContSamps");
    if (mode != AcquisitionType__HW_TIMED_SINGLE_POINT || !(rate_hz > 0.0) ||
        strcmp(source, is_master ? "" : clock) != 0)
        return INVALID_ATTRIBUTE_VALUE;
    task->period_ns = (int64_t)llround(1e9 / rate_hz);
    return 0;
}

EXPORT int32_t DAQmxCfgSampClkTiming(TaskHandle handle, const char *source, double rate,
                                     int32_t edge, int32_t mode, uint64_t samples)
{
    (void)edge, (void)samples;
    CALL(0.0, clock_task(task_of(handle), source, rate, mode));
}

/* --- reading and writing --- */

/* A task that is not running is started for the call and stopped after it. */
static int32_t with_task(Task *task, int32_t type, int32_t (*work)(const Task *, void *), void *value)
{
    if (!task)
        return INVALID_TASK;
    if (task->type != type)
        return CAN_NOT_PERFORM_OP_WHEN_NO_CHANS_IN_TASK;
    bool was_running = task->is_running;
    int32_t code = start(task);
    if (code == 0)
        code = work(task, value);
    if (!was_running)
        unreserve(task);
    return code;
}

/* What a read asks for, and how long it may wait. */
typedef struct {
    double timeout_s;
    double volts;
    int64_t count;
} Reading;

static int32_t sense(const Task *task, void *into)
{
    Reading *reading = into;
    if (task->period_ns) {
        int32_t code = clock_await(reading->timeout_s);
        reading->volts = device_attach()->sampled_v;
        return code;
    }
    int number = number_of(task->physical, "ai", AI_CHANNELS);
    reading->volts = device_sense_v(number, task->full_scale_v);
    return 0;
}

static int32_t read_voltage(Task *task, double timeout_s, double *value)
{
    Reading reading = {.timeout_s = timeout_s};
    int32_t code = with_task(task, ChannelType__ANALOG_INPUT, sense, &reading);
    *value = reading.volts;
    return code;
}

EXPORT int32_t DAQmxReadAnalogScalarF64(TaskHandle handle, double timeout, double *value,
                                        bool32 *reserved)
{
    (void)reserved;
    CALL(timeout, read_voltage(task_of(handle), timeout, value));
}

/* Of a finite task whose input is wired to AO 0: what that put out since the task started. */
static int32_t read_buffer(const Task *task, int32_t count, double *values, uint32_t size)
{
    if (!task || !task->is_finite || !task->is_running || count < 0 || size < (uint32_t)count)
        return INVALID_TASK;
    bool is_wired = number_of(task->physical, "ai", AI_CHANNELS) == device_attach()->loopback_ai;
    for (int32_t i = 0; i < count; i++) {
        int64_t then_ns = task->start_ns + i * task->period_ns;
        values[i] = is_wired ? device_output_v(task->start_ns, task->start_v, then_ns) : 0.0;
    }
    return 0;
}

EXPORT int32_t DAQmxReadAnalogF64(TaskHandle handle, int32_t count, double timeout, int32_t fill,
                                  float64 *values, uint32_t size, int32_t *read, bool32 *reserved)
{
    (void)fill, (void)reserved;
    *read = count;
    CALL(timeout, read_buffer(task_of(handle), count, values, size));
}

static int32_t counted(const Task *task, void *value)
{
    Registers *r = device_attach();
    device_catch_up();
    if (task->period_ns && !r->clock_edges)
        return SAMPLES_NOT_YET_AVAILABLE;
    int64_t count = task->period_ns ? r->sampled_count : r->counter;
    *(int64_t *)value = task->resource == RESOURCE_CTR0 ? count : 0;
    return 0;
}

static int32_t read_position(Task *task, double *value)
{
    int64_t count = 0;
    int32_t code = with_task(task, ChannelType__COUNTER_INPUT, counted, &count);
    if (code)
        return code;
    bool in_ticks = task->units == LengthUnits__TICKS;
    bool is_unsigned = in_ticks && device_attach()->ticks_are_unsigned;
    double signed_count = is_unsigned ? (double)count : (double)(int32_t)count;
    *value = in_ticks ? signed_count : signed_count * counter_resolution(task);
    return 0;
}

EXPORT int32_t DAQmxReadCounterScalarF64(TaskHandle handle, double timeout, double *value,
                                         bool32 *reserved)
{
    (void)reserved;
    CALL(timeout, read_position(task_of(handle), value));
}

static int32_t read_count(Task *task, uint32_t *value)
{
    int64_t count = 0;
    int32_t code = with_task(task, ChannelType__COUNTER_INPUT, counted, &count);
    *value = (uint32_t)count;
    return code;
}

EXPORT int32_t DAQmxReadCounterScalarU32(TaskHandle handle, double timeout, uint32_t *value,
                                         bool32 *reserved)
{
    (void)reserved;
    CALL(timeout, read_count(task_of(handle), value));
}

static int32_t drive(const Task *task, void *value)
{
    double volts = *(double *)value;
    if (!(volts >= task->lowest && volts <= task->highest)) /* NaN too */
        return INVALID_AO_DATA_WRITE;
    int ao = (int)(task->resource - RESOURCE_AO0);
    (task->period_ns ? device_drive_at_edge : device_drive)(ao, volts);
    return 0;
}

static int32_t write_voltage(Task *task, bool32 auto_start, double volts)
{
    if (task && !task->is_running && !auto_start)
        return CANNOT_WRITE_WHEN_AUTO_START_FALSE_AND_TASK_NOT_RUNNING;
    return with_task(task, ChannelType__ANALOG_OUTPUT, drive, &volts);
}

EXPORT int32_t DAQmxWriteAnalogScalarF64(TaskHandle handle, bool32 auto_start, double timeout,
                                         double value, bool32 *reserved)
{
    (void)reserved;
    CALL(timeout, write_voltage(task_of(handle), auto_start, value));
}

/* --- attributes --- */

static int32_t put_double(double value, va_list into)
{
    *va_arg(into, double *) = value;
    return 0;
}

static int32_t put_int(int32_t value, va_list into)
{
    *va_arg(into, int32_t *) = value;
    return 0;
}

static int32_t put_string(const char *text, va_list into)
{
    char *buffer = va_arg(into, char *);
    return put_text(text, buffer, va_arg(into, uint32_t));
}

static int pfi_lines(void)
{
    return device_attach()->has_37_pins ? 8 : 16;
}

static int32_t put_terminal(const Task *task, int input, va_list into)
{
    char terminal[80];
    snprintf(terminal, sizeof terminal, "/%s/PFI%d", device_attach()->name, task->pfi[input]);
    return put_string(terminal, into);
}

static int32_t channel_attribute(const Task *task, int32_t attribute, va_list into)
{
    if (!task)
        return INVALID_TASK;
    switch (attribute) {
    case 0x187F: /* channel type */
        return put_int(task->type, into);
    case 0x18F5: /* physical channel */
        return put_string(task->physical, into);
    case 0x1097: /* AI terminal configuration */
        return put_int(task->terminal, into);
    case 0x17DE: /* AI minimum */
    case 0x1187: /* AO minimum */
        return put_double(task->lowest, into);
    case 0x17DD: /* AI maximum */
    case 0x1186: /* AO maximum */
        return put_double(task->highest, into);
    case 0x1816: /* AI range, low */
        return put_double(-task->full_scale_v, into);
    case 0x1815: /* AI range, high */
        return put_double(task->full_scale_v, into);
    case 0x1821: /* AI data transfer */
    case 0x134:  /* AO */
    case 0x200:  /* CI */
        return put_int(task->transfer, into);
    case 0x21E6: /* encoder decoding */
        return put_int(task->decoding, into);
    case 0x890: /* index enable */
        return put_int((int32_t)task->z_resets, into);
    case 0x18A9: /* encoder units */
        return put_int(task->units, into);
    case 0x21FB: /* filter of input A */
    case 0x2200: /* filter of input B */
        return put_int((int32_t)task->filter_is_on[attribute == 0x2200], into);
    case 0x21FC: /* its shortest pulse */
    case 0x2201:
        return put_double(task->filter_s[attribute == 0x2201], into);
    case 0x219D: /* input A */
    case 0x219E: /* input B */
        return put_terminal(task, attribute == 0x219E, into);
    case 0x148: /* count */
        device_catch_up();
        return put_int((int32_t)device_attach()->counter, into);
    default: /* the output's idle behaviour among them */
        return ATTR_NOT_SUPPORTED;
    }
}

EXPORT int32_t DAQmxGetChanAttribute(TaskHandle handle, const char *channel, int32_t attribute, ...)
{
    (void)channel;
    va_list into;
    va_start(into, attribute);
    int32_t fault = enter(__func__, 0.0);
    int32_t code =
        fault < 0 ? fault : leave(channel_attribute(task_of(handle), attribute, into), fault);
    va_end(into);
    return code;
}

static int32_t set_filter_width(Task *task, int input, double width_s)
{
    static const double widths_s[] = {125e-9, 6.425e-6, 2.55e-3};
    for (int i = 0; i < 3; i++)
        if (fabs(width_s / widths_s[i] - 1.0) < 1e-6) {
            task->filter_s[input] = width_s;
            return 0;
        }
    char requested[32];
    snprintf(requested, sizeof requested, "%g", width_s);
    return refuse_value(task,
                        input ? "DAQmx_CI_Encoder_BInput_DigFltr_MinPulseWidth"
                              : "DAQmx_CI_Encoder_AInput_DigFltr_MinPulseWidth",
                        requested, "125.0e-9, 6.425e-6, 2.55e-3");
}

static int32_t set_terminal(Task *task, int input, const char *terminal)
{
    char known[80];
    for (int line = 0; line < pfi_lines(); line++) {
        snprintf(known, sizeof known, "/%s/PFI%d", device_attach()->name, line);
        if (strcmp(terminal, known) == 0) {
            task->pfi[input] = line;
            return 0;
        }
    }
    return refuse_value(task,
                        input ? "DAQmx_CI_Encoder_BInputTerm" : "DAQmx_CI_Encoder_AInputTerm",
                        terminal, pfi_lines() == 8 ? "PFI0 to PFI7" : "PFI0 to PFI15");
}

static int32_t set_transfer(Task *task, const char *property, int32_t transfer)
{
    bool is_known = transfer == DataTransferActiveTransferMode__DMA ||
                    transfer == DataTransferActiveTransferMode__INTERRUPT ||
                    transfer == DataTransferActiveTransferMode__POLLED;
    if (!is_known || (device_attach()->transfer_is_fixed && transfer != task->transfer))
        return refuse_value(task, property, "DAQmx_Val_ProgrammedIO", "DAQmx_Val_DMA");
    task->transfer = transfer;
    return 0;
}

static int32_t set_channel_attribute(Task *task, int32_t attribute, va_list from)
{
    if (!task)
        return INVALID_TASK;
    if (task->is_running)
        return CAN_NOT_PERFORM_OP_WHILE_TASK_RUNNING;
    switch (attribute) {
    case 0x21FB:
    case 0x2200:
        task->filter_is_on[attribute == 0x2200] = va_arg(from, uint32_t);
        return 0;
    case 0x21FC:
    case 0x2201:
        return set_filter_width(task, attribute == 0x2201, va_arg(from, double));
    case 0x219D:
    case 0x219E:
        return set_terminal(task, attribute == 0x219E, va_arg(from, const char *));
    case 0x1821:
        return set_transfer(task, "DAQmx_AI_DataXferMech", va_arg(from, int32_t));
    case 0x134:
        return set_transfer(task, "DAQmx_AO_DataXferMech", va_arg(from, int32_t));
    case 0x200:
        return set_transfer(task, "DAQmx_CI_DataXferMech", va_arg(from, int32_t));
    default:
        return ATTR_NOT_SUPPORTED;
    }
}

EXPORT int32_t DAQmxSetChanAttribute(TaskHandle handle, const char *channel, int32_t attribute, ...)
{
    (void)channel;
    va_list from;
    va_start(from, attribute);
    int32_t fault = enter(__func__, 0.0);
    int32_t code =
        fault < 0 ? fault : leave(set_channel_attribute(task_of(handle), attribute, from), fault);
    va_end(from);
    return code;
}

static int32_t read_attribute(const Task *task, int32_t attribute, va_list into)
{
    if (!task)
        return INVALID_TASK;
    switch (attribute) {
    case 0x2232: /* wait mode */
        return put_int(task->wait_mode, into);
    case 0x217B: /* number of channels */
        return put_int(1, into);
    default:
        return ATTR_NOT_SUPPORTED;
    }
}

EXPORT int32_t DAQmxGetReadAttribute(TaskHandle handle, int32_t attribute, ...)
{
    va_list into;
    va_start(into, attribute);
    int32_t fault = enter(__func__, 0.0);
    int32_t code =
        fault < 0 ? fault : leave(read_attribute(task_of(handle), attribute, into), fault);
    va_end(into);
    return code;
}

static int32_t set_read_attribute(Task *task, int32_t attribute, va_list from)
{
    if (!task)
        return INVALID_TASK;
    if (attribute != 0x2232)
        return ATTR_NOT_SUPPORTED;
    int32_t mode = va_arg(from, int32_t);
    if (mode != WaitMode__POLL && mode != WaitMode__SLEEP && mode != WaitMode__YIELD &&
        mode != WaitMode__WAIT_FOR_INTERRUPT)
        return INVALID_ATTRIBUTE_VALUE;
    task->wait_mode = mode;
    return 0;
}

EXPORT int32_t DAQmxSetReadAttribute(TaskHandle handle, int32_t attribute, ...)
{
    va_list from;
    va_start(from, attribute);
    int32_t fault = enter(__func__, 0.0);
    int32_t code =
        fault < 0 ? fault : leave(set_read_attribute(task_of(handle), attribute, from), fault);
    va_end(from);
    return code;
}

static int32_t task_attribute(const Task *task, int32_t attribute, va_list into)
{
    if (!task)
        return INVALID_TASK;
    switch (attribute) {
    case 0x1276: /* name */
        return put_string(task->name, into);
    case 0x1273: /* channels */
        return put_string(task->channel, into);
    case 0x2181: /* number of channels */
        return put_int(task->type != 0, into);
    case 0x230E: /* devices */
        return put_string(device_attach()->name, into);
    case 0x29BA: /* number of devices */
        return put_int(1, into);
    default:
        return ATTR_NOT_SUPPORTED;
    }
}

EXPORT int32_t DAQmxGetTaskAttribute(TaskHandle handle, int32_t attribute, ...)
{
    va_list into;
    va_start(into, attribute);
    int32_t fault = enter(__func__, 0.0);
    int32_t code =
        fault < 0 ? fault : leave(task_attribute(task_of(handle), attribute, into), fault);
    va_end(into);
    return code;
}

/* --- device and system --- */

static int32_t put_ranges(va_list into, const double *halves_v, int count)
{
    double ranges_v[8];
    for (int i = 0; i < count; i++) {
        ranges_v[2 * i] = -halves_v[i];
        ranges_v[2 * i + 1] = halves_v[i];
    }
    double *buffer = va_arg(into, double *);
    return put_doubles(ranges_v, 2 * (uint32_t)count, buffer, va_arg(into, uint32_t));
}

static int32_t put_channels(va_list into, const char *kind, int count)
{
    char *buffer = va_arg(into, char *);
    return list_channels(kind, count, buffer, va_arg(into, uint32_t));
}

static int32_t list_terminals(va_list into)
{
    char list[640] = "";
    for (int line = 0, used = 0; line < pfi_lines(); line++)
        used += snprintf(list + used, sizeof list - (size_t)used, "%s/%s/PFI%d", line ? ", " : "",
                         device_attach()->name, line);
    return put_string(list, into);
}

static int32_t device_attribute(const char *device, int32_t attribute, va_list into)
{
    if (strcmp(device, device_attach()->name) != 0 || device_attach()->is_gone)
        return INVALID_DEVICE_ID;
    switch (attribute) {
    case 0x631: /* product type */
        return put_string(device_attach()->has_37_pins ? "PCI-6221 (37-pin)" : "PCI-6221", into);
    case 0x29A9: /* product category */
        return put_int(ProductCategory__M_SERIES_DAQ, into);
    case 0x632: /* serial number */
        return put_int((int32_t)SERIAL_NUMBER, into);
    case 0x231D: /* product number */
        return put_int(0x70AF, into);
    case 0x22CA: /* is it NI's own simulation */
        return put_int(0, into);
    case 0x2326: /* bus */
        return put_int((int32_t)device_attach()->bus, into);
    case 0x231E: /* AI channels */
        return put_channels(into, "ai", AI_CHANNELS);
    case 0x231F: /* AO channels */
        return put_channels(into, "ao", AO_CHANNELS);
    case 0x2324: /* CI channels */
        return put_channels(into, "ctr", COUNTERS);
    case 0x2A40: /* terminals */
        return list_terminals(into);
    case 0x2990: /* AI ranges */
        return put_ranges(into, INPUT_RANGES_V, 4);
    case 0x299B: /* AO ranges */
        return put_ranges(into, INPUT_RANGES_V + 3, 1);
    case 0x298C: /* AI rate of one channel */
    case 0x298D: /* and of several */
        return put_double(250e3, into);
    case 0x2997: /* AO rate */
        return put_double(833e3, into);
    case 0x299F: /* bits of a counter */
        return put_int(32, into);
    default:
        return ATTR_NOT_SUPPORTED;
    }
}

EXPORT int32_t DAQmxGetDeviceAttribute(const char *device, int32_t attribute, ...)
{
    va_list into;
    va_start(into, attribute);
    int32_t fault = enter(__func__, 0.0);
    int32_t code = fault < 0 ? fault : leave(device_attribute(device, attribute, into), fault);
    va_end(into);
    return code;
}

/* A reset takes the card out of every task's hands, and its outputs to 0 V. */
static int32_t reset(const char *device)
{
    if (strcmp(device, device_attach()->name) != 0)
        return INVALID_DEVICE_ID;
    Registers *r = device_attach();
    if (r->is_gone)
        return DEV_CANNOT_BE_ACCESSED;
    for (Task *task = tasks; task; task = task->next)
        task->is_running = false;
    memset(r->owners, 0, sizeof r->owners);
    r->counter_runs = 0;
    clock_stop();
    for (int ao = 0; ao < AO_CHANNELS; ao++)
        device_drive(ao, 0.0);
    return 0;
}

EXPORT int32_t DAQmxResetDevice(const char *device) { CALL(0.0, reset(device)); }

/* Answered without a device, as NI's is. */
EXPORT int32_t DAQmxGetSystemInfoAttribute(int32_t attribute, ...)
{
    va_list into;
    va_start(into, attribute);
    int32_t code = ATTR_NOT_SUPPORTED;
    switch (attribute) {
    case 0x1272: /* version, major */
        code = put_int(26, into);
        break;
    case 0x1923: /* minor */
        code = put_int(8, into);
        break;
    case 0x2F22: /* update */
        code = put_int(0, into);
        break;
    case 0x193B: /* devices */
        code = put_string(device_attach() && !device_attach()->is_gone ? device_attach()->name : "", into);
        break;
    default:
        break;
    }
    va_end(into);
    return outcome(code);
}

EXPORT int32_t DAQmxSetRuntimeEnvironment(const char *environment, const char *version,
                                          const char *reserved, const char *also_reserved)
{
    (void)environment, (void)version, (void)reserved, (void)also_reserved;
    return 0;
}

EXPORT int32_t DAQmxGetExtendedErrorInfo(char *buffer, uint32_t size)
{
    snprintf(buffer, size, "The stand-in driver says no.\n%s\nStatus Code: %d", last_detail,
             last_error);
    return 0;
}

EXPORT int32_t DAQmxGetErrorString(int32_t code, char *buffer, uint32_t size)
{
    snprintf(buffer, size, "The stand-in driver has something to say about %d.", code);
    return 0;
}
