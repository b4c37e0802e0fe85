#define _GNU_SOURCE
#include "device.h"

#include <errno.h>
#include <fcntl.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/file.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <time.h>
#include <unistd.h>

static Registers *registers;

/* --- the shared file --- */

static void init_mutex(Registers *fresh)
{
    pthread_mutexattr_t attributes;
    pthread_mutexattr_init(&attributes);
    pthread_mutexattr_setpshared(&attributes, PTHREAD_PROCESS_SHARED);
    /* A process that is killed while it holds the mutex must not take the card with it. */
    pthread_mutexattr_setrobust(&attributes, PTHREAD_MUTEX_ROBUST);
    pthread_mutex_init(&fresh->mutex, &attributes);
    fresh->mutex_is_ready = 1;
}

Registers *device_attach(void)
{
    const char *path = getenv("STANDIN_DEVICE");
    if (registers || !path)
        return registers;
    int file = open(path, O_RDWR | O_CLOEXEC);
    struct stat status;
    if (file < 0)
        return NULL;
    flock(file, LOCK_EX);
    if (fstat(file, &status) == 0 && (size_t)status.st_size >= sizeof(Registers)) {
        void *mapped =
            mmap(NULL, sizeof(Registers), PROT_READ | PROT_WRITE, MAP_SHARED, file, 0);
        if (mapped != MAP_FAILED && ((Registers *)mapped)->size == sizeof(Registers)) {
            registers = mapped;
            if (!registers->mutex_is_ready)
                init_mutex(registers);
        }
    }
    flock(file, LOCK_UN); /* the mapping would keep it */
    close(file);
    return registers;
}

void device_lock(void)
{
    if (pthread_mutex_lock(&registers->mutex) == EOWNERDEAD)
        pthread_mutex_consistent(&registers->mutex);
}

void device_unlock(void)
{
    pthread_mutex_unlock(&registers->mutex);
}

/* --- time, plant and wires --- */

static void sleep_s(double seconds)
{
    if (seconds <= 0.0)
        return; /* even a sleep of nothing takes 50 us */
    struct timespec rest = {(time_t)seconds, (long)(fmod(seconds, 1.0) * 1e9)};
    while (nanosleep(&rest, &rest) && errno == EINTR)
        ;
}

int64_t device_now_ns(void)
{
    if (registers->is_virtual)
        return registers->virtual_ns;
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return now.tv_sec * 1000000000LL + now.tv_nsec;
}

static int64_t encoder_edges(void)
{
    Registers *r = registers;
    double edges = r->encoder_phase_edges + r->plant.position_m / r->encoder_m_per_edge;
    return r->encoder_sign * (int64_t)floor(edges);
}

/* A and B are high for two edges: a filter longer than that swallows them. */
static bool filter_passes(double edges_per_s)
{
    return registers->counter_filter_s * fabs(edges_per_s) < 2.0;
}

static int64_t floor_div(int64_t value, int64_t divisor)
{
    return value / divisor - (value % divisor < 0);
}

static void count(double duration_s)
{
    Registers *r = registers;
    int64_t before = r->encoder_edges, edges = encoder_edges();
    r->encoder_edges = edges;
    if (r->counter_runs && !r->encoder_is_unplugged &&
        filter_passes((double)(edges - before) / duration_s)) {
        int64_t scale = r->counter_edges_per_count;
        int64_t counted = floor_div(edges, scale) - floor_div(before, scale);
        r->counter = (uint32_t)(r->counter + counted);
    }
}

static void pass_time_until(int64_t then_ns)
{
    Registers *r = registers;
    if (then_ns <= r->plant_ns)
        return;
    double duration_s = (double)(then_ns - r->plant_ns) * 1e-9;
    double valve_v = r->valve_is_stuck ? r->valve_stuck_v : r->ao_v[0];
    plant_advance(&r->plant, (valve_v - r->driver_offset_v) * r->driver_gain, duration_s);
    r->plant_ns = then_ns;
    count(duration_s);
}

static double converted_v(double volts, double full_scale_v)
{
    double step_v = 2.0 * full_scale_v / 65536.0;
    double code = floor(fmin(fmax(volts, -full_scale_v), full_scale_v) / step_v + 0.5);
    return fmin(code, 32767.0) * step_v;
}

static void put_out(int ao, double volts, int64_t when_ns)
{
    Registers *r = registers;
    r->ao_v[ao] = converted_v(volts, 10.0);
    r->ao_ns = when_ns;
    r->ao_history_ns[r->ao_writes % HISTORY] = when_ns;
    r->ao_history_v[r->ao_writes++ % HISTORY] = r->ao_v[ao];
}

void device_glitch(void)
{
    Registers *r = registers;
    double before_v = r->ao_v[0];
    if (!r->ao_glitch_ns)
        return;
    put_out(0, r->ao_glitch_v, device_now_ns());
    if (r->is_virtual)
        r->virtual_ns += r->ao_glitch_ns;
    else
        sleep_s((double)r->ao_glitch_ns * 1e-9);
    put_out(0, before_v, device_now_ns());
}

double device_output_v(int64_t since_ns, double before_v, int64_t then_ns)
{
    Registers *r = registers;
    int64_t oldest = r->ao_writes > HISTORY ? r->ao_writes - HISTORY : 0;
    double volts = before_v;
    for (int64_t n = oldest; n < r->ao_writes; n++) {
        int64_t at_ns = r->ao_history_ns[n % HISTORY];
        if (at_ns >= since_ns && at_ns <= then_ns)
            volts = r->ao_history_v[n % HISTORY];
    }
    return volts;
}

static double uniform(void)
{
    uint64_t x = (uint64_t)registers->noise_state;
    x ^= x << 13;
    x ^= x >> 7;
    x ^= x << 17;
    registers->noise_state = (int64_t)x;
    return ((double)(x >> 11) + 0.5) / 9007199254740992.0;
}

static double noise_v(void)
{
    if (registers->noise_v == 0.0)
        return 0.0;
    double radius = sqrt(-2.0 * log(uniform()));
    return registers->noise_v * radius * cos(2.0 * M_PI * uniform());
}

/* An open input keeps its charge, and the input's own current moves it: NI promises no value. */
static double floating_v(double full_scale_v)
{
    Registers *r = registers;
    double drift_v = r->open_drift_v_per_s * (double)(r->plant_ns - r->open_ns) * 1e-9;
    r->open_v = fmin(fmax(r->open_v + drift_v, -full_scale_v), full_scale_v);
    r->open_ns = r->plant_ns;
    return r->open_v;
}

static double sensed_v(int ai, double full_scale_v)
{
    Registers *r = registers;
    if (ai != 0)
        return r->loopback_ai == ai ? converted_v(r->ao_v[0], full_scale_v) : 0.0;
    if (r->wire_is_broken)
        return r->pull_down_is_missing ? converted_v(floating_v(full_scale_v), full_scale_v) : 0.0;
    double sensor_v = r->sensor_zero_v + (r->plant.pressure_pa - 101.3e3) / r->sensor_pa_per_v;
    r->open_v = sensor_v;
    r->open_ns = r->plant_ns;
    return converted_v(sensor_v + noise_v(), full_scale_v);
}

/* --- the sample clock --- */

static int64_t next_edge_ns(void)
{
    return registers->clock_start_ns + (registers->clock_edges + 1) * registers->clock_period_ns;
}

/* Inputs are taken and outputs put out at the same instant: these act on the next sample. */
static void pass_edge(void)
{
    Registers *r = registers;
    int64_t edge_ns = next_edge_ns();
    pass_time_until(edge_ns);
    r->clock_edges++;
    r->sampled_v = sensed_v(0, r->ai_full_scale_v);
    r->sampled_count = r->counter;
    for (int ao = 0; ao < AO_CHANNELS; ao++)
        if (r->ao_is_pending[ao]) {
            r->ao_is_pending[ao] = 0;
            put_out(ao, r->ao_pending_v[ao], edge_ns);
        }
}

void clock_start(int64_t period_ns)
{
    Registers *r = registers;
    device_catch_up();
    r->clock_start_ns = device_now_ns();
    r->clock_period_ns = period_ns;
    r->clock_edges = r->clock_read = 0;
    r->clock_runs = 1;
}

void clock_stop(void)
{
    Registers *r = registers;
    r->clock_runs = 0;
    memset(r->ao_is_pending, 0, sizeof r->ao_is_pending);
}

void device_catch_up(void)
{
    Registers *r = registers;
    int64_t now_ns = device_now_ns();
    if (r->plant_ns == 0) {
        r->plant_ns = now_ns;
        r->encoder_edges = encoder_edges();
    }
    if (r->clock_runs && !device_owner_lives(RESOURCE_AI))
        clock_stop();
    while (r->clock_runs && next_edge_ns() <= now_ns)
        pass_edge();
    pass_time_until(now_ns);
}

static void wait_unlocked(double seconds)
{
    device_unlock();
    sleep_s(seconds);
    device_lock();
}

int32_t clock_await(double timeout_s)
{
    Registers *r = registers;
    device_catch_up();
    int64_t deadline_ns = device_now_ns() + (int64_t)(timeout_s * 1e9);
    while (!r->clock_runs || r->clock_edges <= r->clock_read + r->clock_skips) {
        int64_t now_ns = device_now_ns(), edge_ns = next_edge_ns();
        if (!r->clock_runs || edge_ns > deadline_ns) {
            wait_unlocked(r->is_virtual ? 0.0 : (double)(deadline_ns - now_ns) * 1e-9);
            return SAMPLES_NOT_YET_AVAILABLE;
        }
        if (r->is_virtual)
            r->virtual_ns = edge_ns;
        else
            wait_unlocked((double)(edge_ns - now_ns) * 1e-9);
        device_catch_up();
    }
    int64_t passed = r->clock_edges - r->clock_read;
    r->clock_read = r->clock_edges;
    return passed > 1 ? (int32_t)r->late_code : 0;
}

/* --- what the tasks ask for --- */

void device_drive(int ao, double volts)
{
    device_catch_up();
    put_out(ao, volts, device_now_ns());
}

void device_drive_at_edge(int ao, double volts)
{
    device_catch_up();
    registers->ao_is_pending[ao] = 1;
    registers->ao_pending_v[ao] = volts;
}

double device_sense_v(int ai, double full_scale_v)
{
    device_catch_up();
    return sensed_v(ai, full_scale_v);
}

void device_note_move(Resource resource, bool is_start)
{
    int64_t number = (int64_t)resource + 1;
    registers->move[registers->moves++ % HISTORY] = is_start ? number : -number;
}

void counter_start(int64_t initial, int64_t edges_per_count, double filter_s, bool z_resets)
{
    device_catch_up();
    registers->counter = (uint32_t)initial;
    registers->counter_edges_per_count = edges_per_count;
    registers->counter_filter_s = filter_s;
    registers->counter_z_resets = z_resets;
    registers->counter_runs = 1;
}

/* --- reservations, which die with their owner --- */

/* When a process was born, in ticks since boot; 0 if it lives no longer. */
static int64_t birth_of(int64_t pid)
{
    char path[40], line[1024] = "", state = 'X';
    long long born = 0;
    snprintf(path, sizeof path, "/proc/%lld/stat", (long long)pid);
    FILE *file = fopen(path, "re");
    if (!file)
        return 0;
    char *name_end = fgets(line, sizeof line, file) ? strrchr(line, ')') : NULL;
    fclose(file);
    if (name_end)
        sscanf(name_end + 2,
               "%c %*s %*s %*s %*s %*s %*s %*s %*s %*s %*s %*s %*s %*s %*s %*s %*s %*s %*s %lld",
               &state, &born);
    return state == 'Z' || state == 'X' ? 0 : born;
}

bool device_owns(Resource resource, int64_t task)
{
    Owner *owner = &registers->owners[resource];
    return owner->pid == getpid() && owner->task == task;
}

bool device_owner_lives(Resource resource)
{
    Owner *owner = &registers->owners[resource];
    return owner->pid == getpid() || (owner->pid && birth_of(owner->pid) == owner->born);
}

bool device_reserve(Resource resource, int64_t task)
{
    Owner *owner = &registers->owners[resource];
    if (device_owns(resource, task))
        return true;
    if (owner->pid && (registers->keeps_dead_owners || device_owner_lives(resource)))
        return false;
    *owner = (Owner){getpid(), birth_of(getpid()), task};
    return true;
}

void device_release(Resource resource, int64_t task)
{
    if (device_owns(resource, task))
        registers->owners[resource] = (Owner){0, 0, 0};
}

/* --- faults --- */

static Fault due_fault(const char *function)
{
    for (Fault *fault = registers->faults; fault < registers->faults + FAULTS; fault++) {
        if (fault->times == 0 || strcmp(fault->function, function) != 0)
            continue;
        if (fault->after-- > 0)
            continue;
        fault->after = 0;
        fault->times--;
        return *fault;
    }
    return (Fault){0};
}

int32_t device_fault(const char *function, double timeout_s)
{
    device_lock();
    Fault fault = due_fault(function);
    device_unlock();
    bool times_out = fault.hang_s > timeout_s && !fault.is_deaf;
    sleep_s(times_out ? timeout_s : fault.hang_s);
    return times_out ? SAMPLES_NOT_YET_AVAILABLE : (int32_t)fault.code;
}
