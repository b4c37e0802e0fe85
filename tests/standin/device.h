/* The card: its registers in a shared file, and the muscle on the other side of the wires.

   The file outlives every process that maps it, as a card does: an output holds its voltage
   and the muscle goes on moving whoever dies. `tests/standin/standin.py` mirrors `Registers`. */
#pragma once

#include <pthread.h>
#include <stdbool.h>
#include <stdint.h>

#include "plant.h"

#define SERIAL_NUMBER 0xDECAFu

enum { AO_CHANNELS = 2, AI_CHANNELS = 16, COUNTERS = 2, FAULTS = 8, HISTORY = 64 };

/* The one error that the device itself gives, by NI's number. */
#define SAMPLES_NOT_YET_AVAILABLE (-200284)

typedef enum {
    RESOURCE_AI, /* one converter for all inputs */
    RESOURCE_AO0,
    RESOURCE_AO1,
    RESOURCE_CTR0,
    RESOURCE_CTR1,
    RESOURCES
} Resource;

/* What goes wrong: `times` calls of `function`, after so many that go right. */
typedef struct {
    char function[48];
    int64_t code; /* negative: the call fails; positive: it works, with a warning */
    int64_t after;
    int64_t times;
    double hang_s;
    int64_t is_deaf; /* the hanging call does not heed its timeout */
} Fault;

/* Who has reserved a resource. A process is known by its id and the time it was born. */
typedef struct {
    int64_t pid;
    int64_t born;
    int64_t task;
} Owner;

/* Eight bytes a field: no padding that a mirror could get wrong. */
typedef struct {
    int64_t size;
    char name[40]; /* of the device: a lock bears it, so cards side by side need their own */
    int64_t is_virtual; /* time stands still but for whoever moves `virtual_ns` */
    int64_t virtual_ns;
    int64_t plant_ns; /* the plant has come so far; 0: it begins at the next access */
    Plant plant;
    double ao_v[AO_CHANNELS];
    int64_t ao_ns; /* when an output was last written */
    int64_t ao_writes;
    double ao_history_v[HISTORY]; /* the last writes, a ring: number n is at n % HISTORY */
    int64_t ao_history_ns[HISTORY];
    double ao_glitch_v; /* what AO 0 puts out when its task starts, for `ao_glitch_ns` */
    int64_t ao_glitch_ns;
    int64_t loopback_ai; /* the input that AO 0 is wired to; 0: none */
    double driver_offset_v;
    double driver_gain; /* V of command per V of output; -1: a valve plumbed the wrong way */
    double sensor_zero_v;
    double sensor_pa_per_v;
    double noise_v;
    int64_t noise_state;
    int64_t wire_is_broken; /* the pressure input is open: a pull-down takes it to 0 V */
    int64_t pull_down_is_missing; /* an open input drifts from where it was */
    double open_drift_v_per_s;
    double open_v;     /* of the open input, at `open_ns` */
    int64_t open_ns;
    int64_t ai_terminal;    /* of the input task that was started last */
    double ai_full_scale_v;
    double encoder_m_per_edge;
    double encoder_phase_edges; /* where between two edges the vented muscle rests */
    int64_t encoder_sign;
    int64_t encoder_is_unplugged;
    int64_t encoder_edges; /* seen last */
    int64_t counter; /* of counter 0, 32 bits of it */
    int64_t counter_runs;
    int64_t counter_edges_per_count;
    double counter_filter_s; /* pulses shorter than this do not count */
    int64_t counter_z_resets; /* recorded only: this encoder strip has no index */
    int64_t ticks_are_unsigned; /* how a read in ticks shows a count below zero */
    int64_t counter_maxdata; /* all bits of the counter as comedi shows it */
    int64_t encoder_pfi[2];  /* the PFI lines that A and B are wired to */
    int64_t has_37_pins;     /* the variant with PFI 0 to 7 only */
    /* What the card's own codes are off by: ideal volts become `volts * gain + offset_v`. */
    double ai_gain;
    double ai_offset_v;
    double ao_gain;
    double ao_offset_v;
    int64_t is_gone; /* the card is no longer on the bus */
    int64_t bus;     /* a BusType: what it is plugged into */
    int64_t valve_is_stuck; /* the valve stands at `valve_stuck_v`, whatever the output says */
    double valve_stuck_v;
    /* The sample clock of the analog input, for hardware-timed single points. */
    int64_t clock_runs;
    int64_t clock_start_ns;
    int64_t clock_period_ns;
    int64_t clock_edges; /* passed since the start */
    int64_t clock_read;  /* of these, the one whose sample was read last */
    double sampled_v;    /* what the input was at the last edge */
    int64_t sampled_count;
    int64_t ao_is_pending[AO_CHANNELS]; /* a voltage waits for the next edge */
    double ao_pending_v[AO_CHANNELS];
    int64_t clock_skips; /* edges that pass unseen before each one that a read returns */
    int64_t ai_wait_mode; /* a WaitMode: of the input task that was started last */
    int64_t transfer_is_fixed; /* the driver refuses to change how data are transferred */
    int64_t late_code; /* what a read says that comes after a missed edge; 0: nothing */
    int64_t moves;     /* starts and stops of tasks ever */
    int64_t move[HISTORY]; /* the last ones: a Resource + 1, negative for a stop */
    int64_t keeps_dead_owners; /* a killed process's reservation stays until a reset */
    Owner owners[RESOURCES];
    Fault faults[FAULTS];
    int64_t mutex_is_ready;
    pthread_mutex_t mutex;
} Registers;

/* The registers of the file that STANDIN_DEVICE names; NULL without one. */
Registers *device_attach(void);
void device_lock(void);
void device_unlock(void);

int64_t device_now_ns(void);
void device_catch_up(void);
void device_drive(int ao, double volts);
/* The same, but at the next edge of the sample clock. */
void device_drive_at_edge(int ao, double volts);
/* AO 0 starts: its glitch, if it has one. */
void device_glitch(void);
/* What AO 0 was at a time not before `since_ns`, when it was `before_v`. */
double device_output_v(int64_t since_ns, double before_v, int64_t then_ns);
double device_sense_v(int ai, double full_scale_v);

void clock_start(int64_t period_ns);
void clock_stop(void);
/* Wait for an edge whose sample has not been read: 0, the code of a late one, or a timeout.
   Called locked; lets go of the lock while it waits. */
int32_t clock_await(double timeout_s);
void device_note_move(Resource resource, bool is_start);
void counter_start(int64_t initial, int64_t edges_per_count, double filter_s, bool z_resets);

bool device_reserve(Resource resource, int64_t task);
bool device_owns(Resource resource, int64_t task);
bool device_owner_lives(Resource resource);
void device_release(Resource resource, int64_t task);

/* The code due to this call, having waited as long as a fault wants; call it unlocked. */
int32_t device_fault(const char *function, double timeout_s);
