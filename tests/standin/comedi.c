/* A stand-in for libcomedi and for the kernel's driver ni_pcimio below it: as much of both as one
   analog input, two analog outputs and two quadrature counters of an M Series card need.

   It encodes a reading of public sources, not a measurement: it proves nothing about a real card.
   Numbers and structures are those of the kernel's public header. Locks belong to an open file and
   go with its process, as the kernel's do. */
#include "device.h"

#include <errno.h>
#include <fcntl.h>
#include <linux/comedi.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#ifndef EXPORT
#define EXPORT __attribute__((visibility("default")))
#endif

/* Of comedilib.h: the library's own types. */
typedef unsigned int lsampl_t;
typedef struct comedi_insn comedi_insn;
typedef struct comedi_insnlist comedi_insnlist;

typedef struct comedi_t_struct {
    int file;
    int64_t id; /* who holds a lock: in the kernel this is the open file */
} comedi_t;

typedef struct {
    double min;
    double max;
    unsigned int unit;
} comedi_range;

typedef struct {
    double coefficients[4];
    double expansion_origin;
    unsigned order;
} comedi_polynomial_t;

enum comedi_conversion_direction { COMEDI_TO_PHYSICAL, COMEDI_FROM_PHYSICAL };

/* The kernel gives up on a converter that is silent for so long. */
static const double KERNEL_PATIENCE_S = 0.02;

static int last_error;

/* --- entering and leaving a call --- */

static int outcome(int code)
{
    if (code >= 0)
        return code;
    last_error = -code;
    return -1;
}

static int enter(const char *function)
{
    int32_t fault = device_fault(function, KERNEL_PATIENCE_S);
    device_lock();
    if (fault < 0)
        return fault == SAMPLES_NOT_YET_AVAILABLE ? -ETIME : fault;
    return device_attach()->is_gone ? -ENODEV : 0;
}

/* Run `work` under the lock, unless a fault is due. */
#define CALL(work)                                                                                 \
    do {                                                                                           \
        int fault = enter(__func__);                                                               \
        int code = fault ? fault : (work);                                                         \
        device_unlock();                                                                           \
        return outcome(code);                                                                      \
    } while (0)

/* --- the device file --- */

/* Where the registers lie: as the environment had it when the card was first looked for. */
static char registers_path[4096];

static bool find_card(void)
{
    if (device_attach() && !*registers_path)
        snprintf(registers_path, sizeof registers_path, "%s", getenv("STANDIN_DEVICE"));
    return *registers_path;
}

/* A card that bears a name of NI's driver is the first one here. */
static bool is_my_file(const char *path)
{
    const char *name = device_attach()->name;
    char mine[64];
    snprintf(mine, sizeof mine, "/dev/%s", strncmp(name, "comedi", 6) == 0 ? name : "comedi0");
    return strcmp(path, mine) == 0;
}

static int open_file(const char *path)
{
    if (!find_card() || !is_my_file(path))
        return -ENOENT;
    int fault = enter("comedi_open");
    device_unlock();
    return fault ? fault : open(registers_path, O_RDWR);
}

EXPORT comedi_t *comedi_open(const char *path)
{
    static int64_t last_id;
    int file = outcome(open_file(path));
    if (file < 0)
        return NULL;
    comedi_t *device = calloc(1, sizeof *device);
    *device = (comedi_t){file, ++last_id};
    return device;
}

EXPORT int comedi_close(comedi_t *device)
{
    device_lock();
    for (int resource = 0; resource < RESOURCES; resource++)
        device_release((Resource)resource, device->id);
    device_unlock();
    close(device->file);
    free(device);
    return 0;
}

EXPORT int comedi_errno(void)
{
    return last_error;
}

EXPORT const char *comedi_strerror(int number)
{
    return strerror(number);
}

EXPORT int comedi_fileno(comedi_t *device)
{
    return device->file;
}

EXPORT int comedi_get_version_code(comedi_t *device)
{
    (void)device;
    return 0 << 16 | 7 << 8 | 76;
}

EXPORT const char *comedi_get_driver_name(comedi_t *device)
{
    (void)device;
    return "stand_in";
}

EXPORT const char *comedi_get_board_name(comedi_t *device)
{
    (void)device;
    return "pci-6221";
}

/* --- subdevices, numbered as the kernel's driver numbers them --- */

enum { AI = 0, AO = 1, DIO = 2, PFI = 7, RTSI = 10, CTR0 = 11, CTR1 = 12, FREQ_OUT = 13, COUNT };
enum { PFI_LINES = 16, CODES = 65536, ZERO_CODE = 32768 };

typedef struct {
    int type;
    int channels;
    unsigned flags;
} Subdevice;

static const Subdevice SUBDEVICES[COUNT] = {
    [AI] = {COMEDI_SUBD_AI, AI_CHANNELS,
            SDF_READABLE | SDF_GROUND | SDF_COMMON | SDF_DIFF | SDF_SOFT_CALIBRATED},
    [AO] = {COMEDI_SUBD_AO, AO_CHANNELS, SDF_WRITABLE | SDF_GROUND | SDF_SOFT_CALIBRATED},
    [DIO] = {COMEDI_SUBD_DIO, 8, SDF_READABLE | SDF_WRITABLE},
    [PFI] = {COMEDI_SUBD_DIO, PFI_LINES, SDF_READABLE | SDF_WRITABLE | SDF_INTERNAL},
    [RTSI] = {COMEDI_SUBD_DIO, 8, SDF_READABLE | SDF_WRITABLE | SDF_INTERNAL},
    [CTR0] = {COMEDI_SUBD_COUNTER, 3, SDF_READABLE | SDF_WRITABLE | SDF_LSAMPL},
    [CTR1] = {COMEDI_SUBD_COUNTER, 3, SDF_READABLE | SDF_WRITABLE | SDF_LSAMPL},
    [FREQ_OUT] = {COMEDI_SUBD_COUNTER, 1, SDF_READABLE | SDF_WRITABLE},
};

static comedi_range INPUT_RANGES[] = {
    {-10.0, 10.0, UNIT_volt}, {-5.0, 5.0, UNIT_volt}, {-1.0, 1.0, UNIT_volt}, {-0.2, 0.2, UNIT_volt}};
static comedi_range OUTPUT_RANGES[] = {{-10.0, 10.0, UNIT_volt}};

static int count_ranges(unsigned subdevice)
{
    return subdevice == AI ? 4 : 1;
}

static bool is_counter(unsigned subdevice)
{
    return subdevice == CTR0 || subdevice == CTR1;
}

static int find_subdevice(int type, unsigned first)
{
    for (unsigned subdevice = first; subdevice < COUNT; subdevice++)
        if (SUBDEVICES[subdevice].type == type)
            return (int)subdevice;
    return -EINVAL;
}

EXPORT int comedi_find_subdevice_by_type(comedi_t *device, int type, unsigned int first)
{
    (void)device;
    CALL(find_subdevice(type, first));
}

EXPORT int comedi_get_subdevice_flags(comedi_t *device, unsigned int subdevice)
{
    (void)device;
    CALL(subdevice < COUNT ? (int)SUBDEVICES[subdevice].flags : -EINVAL);
}

EXPORT int comedi_get_n_channels(comedi_t *device, unsigned int subdevice)
{
    (void)device;
    CALL(subdevice < COUNT ? SUBDEVICES[subdevice].channels : -EINVAL);
}

EXPORT lsampl_t comedi_get_maxdata(comedi_t *device, unsigned int subdevice, unsigned int channel)
{
    (void)device, (void)channel;
    return is_counter(subdevice) ? (lsampl_t)device_attach()->counter_maxdata : CODES - 1;
}

EXPORT int comedi_get_n_ranges(comedi_t *device, unsigned int subdevice, unsigned int channel)
{
    (void)device, (void)channel;
    CALL(count_ranges(subdevice));
}

EXPORT comedi_range *comedi_get_range(comedi_t *device, unsigned int subdevice,
                                      unsigned int channel, unsigned int range)
{
    (void)device, (void)channel;
    return subdevice == AI ? &INPUT_RANGES[range] : &OUTPUT_RANGES[range];
}

/* --- locks --- */

static int resource_of(unsigned subdevice)
{
    switch (subdevice) {
    case AI:
        return RESOURCE_AI;
    case AO: /* one lock for both outputs */
        return RESOURCE_AO0;
    case CTR0:
        return RESOURCE_CTR0;
    case CTR1:
        return RESOURCE_CTR1;
    default:
        return -1;
    }
}

static int lock(const comedi_t *device, unsigned subdevice)
{
    int resource = resource_of(subdevice);
    if (resource < 0)
        return -EINVAL;
    if (device_owner_lives((Resource)resource)) /* the kernel refuses its owner too */
        return -EBUSY;
    device_reserve((Resource)resource, device->id);
    return 0;
}

static bool is_locked_by_another(const comedi_t *device, unsigned subdevice)
{
    int resource = resource_of(subdevice);
    return resource >= 0 && device_owner_lives((Resource)resource) &&
           !device_owns((Resource)resource, device->id);
}

static int unlock(const comedi_t *device, unsigned subdevice)
{
    if (is_locked_by_another(device, subdevice))
        return -EACCES;
    device_release((Resource)resource_of(subdevice), device->id);
    return 0;
}

EXPORT int comedi_lock(comedi_t *device, unsigned int subdevice)
{
    CALL(lock(device, subdevice));
}

EXPORT int comedi_unlock(comedi_t *device, unsigned int subdevice)
{
    CALL(unlock(device, subdevice));
}

/* --- converters --- */

static lsampl_t clamp_code(double code)
{
    return (lsampl_t)fmin(fmax(floor(code + 0.5), 0.0), CODES - 1);
}

static lsampl_t convert_input(unsigned chanspec)
{
    Registers *r = device_attach();
    double full_scale_v = INPUT_RANGES[CR_RANGE(chanspec)].max;
    r->ai_terminal = CR_AREF(chanspec);
    r->ai_full_scale_v = full_scale_v;
    double volts = device_sense_v((int)CR_CHAN(chanspec), full_scale_v);
    return clamp_code((volts * r->ai_gain + r->ai_offset_v) / (2.0 * full_scale_v / CODES) +
                      ZERO_CODE);
}

static void convert_output(unsigned chanspec, lsampl_t code)
{
    Registers *r = device_attach();
    double volts = ((double)code - ZERO_CODE) * (20.0 / CODES);
    device_drive((int)CR_CHAN(chanspec), volts * r->ao_gain + r->ao_offset_v);
}

/* --- counters --- */

/* How the two counters and the PFI lines are set up. */
static struct {
    unsigned mode;
    unsigned gate[2];
    unsigned source[3]; /* of A, B and Z */
} set_up[2];
static unsigned pfi_filter[PFI_LINES];

static const double FILTERS_S[] = {0.0, 125e-9, 6.425e-6, 2.55e-3};

static int edges_per_count(unsigned mode)
{
    switch (mode & NI_GPCT_COUNTING_MODE_MASK) {
    case NI_GPCT_COUNTING_MODE_QUADRATURE_X4_BITS:
        return 1;
    case NI_GPCT_COUNTING_MODE_QUADRATURE_X2_BITS:
        return 2;
    case NI_GPCT_COUNTING_MODE_QUADRATURE_X1_BITS:
        return 4;
    default:
        return 0;
    }
}

/* 1 as wired, -1 with A and B crossed, 0 where the encoder is on other lines. */
static int wired_sign(const unsigned *source)
{
    const int64_t *line = device_attach()->encoder_pfi;
    unsigned a = NI_GPCT_PFI_OTHER_SELECT(line[0]), b = NI_GPCT_PFI_OTHER_SELECT(line[1]);
    return source[0] == a && source[1] == b ? 1 : source[0] == b && source[1] == a ? -1 : 0;
}

static double longest_filter_s(void)
{
    const int64_t *line = device_attach()->encoder_pfi;
    return fmax(FILTERS_S[pfi_filter[line[0]]], FILTERS_S[pfi_filter[line[1]]]);
}

static void arm(int counter)
{
    unsigned mode = set_up[counter].mode;
    int edges = edges_per_count(mode) * wired_sign(set_up[counter].source);
    bool is_gated = !(set_up[counter].gate[0] & set_up[counter].gate[1] &
                      NI_GPCT_DISABLED_GATE_SELECT);
    bool follows_phase = (mode & NI_GPCT_COUNTING_DIRECTION_MASK) ==
                         NI_GPCT_COUNTING_DIRECTION_HW_UP_DOWN_BITS;
    if (counter != 0 || !edges || is_gated || !follows_phase)
        return;
    counter_start(device_attach()->counter, edges, longest_filter_s(),
                  mode & NI_GPCT_INDEX_ENABLE_BIT);
    device_note_move(RESOURCE_CTR0, true);
}

static void reset(int counter)
{
    if (counter == 0) {
        device_catch_up();
        device_attach()->counter = device_attach()->counter_runs = 0;
    }
}

static int configure_counter(int counter, const comedi_insn *insn)
{
    const unsigned *data = insn->data;
    switch (data[0]) {
    case INSN_CONFIG_RESET:
        return insn->n == 1 ? reset(counter), 0 : -EINVAL;
    case INSN_CONFIG_ARM:
        return insn->n == 2 ? arm(counter), 0 : -EINVAL;
    case INSN_CONFIG_SET_COUNTER_MODE:
        return insn->n == 2 ? set_up[counter].mode = data[1], 0 : -EINVAL;
    case INSN_CONFIG_SET_CLOCK_SRC:
        return insn->n == 3 ? 0 : -EINVAL;
    case INSN_CONFIG_SET_GATE_SRC:
        return insn->n == 3 && data[1] < 2 ? set_up[counter].gate[data[1]] = data[2], 0 : -EINVAL;
    case INSN_CONFIG_SET_OTHER_SRC:
        return insn->n == 3 && data[1] < 3 ? set_up[counter].source[data[1]] = data[2], 0 : -EINVAL;
    default:
        return -EINVAL;
    }
}

static int configure_pfi(const comedi_insn *insn)
{
    const unsigned *data = insn->data;
    if (data[0] == COMEDI_INPUT && insn->n == 1)
        return 0;
    if (data[0] != INSN_CONFIG_FILTER || insn->n != 2 || data[1] > NI_PFI_FILTER_2550us)
        return -EINVAL;
    pfi_filter[CR_CHAN(insn->chanspec)] = data[1];
    return 0;
}

/* --- instructions --- */

static int read_code(const comedi_insn *insn)
{
    if (insn->subdev == AI) {
        *insn->data = convert_input(insn->chanspec);
        return 0;
    }
    if (!is_counter(insn->subdev))
        return -EINVAL;
    device_catch_up();
    Registers *r = device_attach();
    *insn->data = insn->subdev == CTR0 ? (lsampl_t)(r->counter & r->counter_maxdata) : 0;
    return 0;
}

static int write_code(const comedi_insn *insn)
{
    if (insn->subdev == AO) {
        if (*insn->data >= CODES)
            return -EINVAL;
        convert_output(insn->chanspec, *insn->data);
        return 0;
    }
    if (!is_counter(insn->subdev))
        return -EINVAL;
    if (insn->subdev == CTR0 && CR_CHAN(insn->chanspec) == 0)
        device_attach()->counter = *insn->data;
    return 0;
}

static int configure(const comedi_insn *insn)
{
    if (is_counter(insn->subdev))
        return configure_counter((int)insn->subdev - CTR0, insn);
    return insn->subdev == PFI ? configure_pfi(insn) : -EINVAL;
}

static int run(const comedi_t *device, const comedi_insn *insn)
{
    if (insn->subdev >= COUNT)
        return -EINVAL;
    if (SUBDEVICES[insn->subdev].type == COMEDI_SUBD_UNUSED)
        return -EIO;
    if (is_locked_by_another(device, insn->subdev))
        return -EACCES;
    if ((int)CR_CHAN(insn->chanspec) >= SUBDEVICES[insn->subdev].channels ||
        (int)CR_RANGE(insn->chanspec) >= count_ranges(insn->subdev) || insn->n < 1)
        return -EINVAL;
    int code = insn->insn == INSN_READ     ? read_code(insn)
               : insn->insn == INSN_WRITE  ? write_code(insn)
               : insn->insn == INSN_CONFIG ? configure(insn)
                                           : -EINVAL;
    return code ? code : (int)insn->n;
}

/* The first instruction that fails ends the list, and the call says nothing of those before it. */
static int run_list(const comedi_t *device, const comedi_insnlist *list)
{
    for (unsigned i = 0; i < list->n_insns; i++) {
        int code = run(device, &list->insns[i]);
        if (code < 0)
            return code;
    }
    return (int)list->n_insns;
}

EXPORT int comedi_do_insn(comedi_t *device, comedi_insn *insn)
{
    CALL(run(device, insn));
}

EXPORT int comedi_do_insnlist(comedi_t *device, comedi_insnlist *list)
{
    CALL(run_list(device, list));
}

EXPORT int comedi_data_write(comedi_t *device, unsigned int subdevice, unsigned int channel,
                             unsigned int range, unsigned int reference, lsampl_t code)
{
    comedi_insn insn = {.insn = INSN_WRITE,
                        .n = 1,
                        .data = &code,
                        .subdev = subdevice,
                        .chanspec = CR_PACK(channel, range, reference)};
    CALL(run(device, &insn));
}

/* --- software calibration --- */

typedef struct {
    bool is_there;
    comedi_polynomial_t polynomial;
} Converter;

typedef struct {
    unsigned subdevice;
    int range; /* -1: for all */
    Converter to_phys;
    Converter from_phys;
} Setting;

enum { SETTINGS = 8 };

typedef struct {
    int count;
    Setting settings[SETTINGS];
} comedi_calibration_t;

/* The numbers behind `key => [`, at most four; how many there are. */
static int read_numbers(const char *text, const char *key, double *numbers)
{
    const char *at = strstr(text, key);
    at = at ? strchr(at, '[') : NULL;
    int count = 0;
    for (char *end; at && count < 4; at = end, count++) {
        numbers[count] = strtod(at + 1, &end);
        if (end == at + 1)
            break;
    }
    return count;
}

static Converter read_converter(const char *text, const char *key)
{
    Converter read = {0};
    const char *at = strstr(text, key);
    const char *origin = at ? strstr(at, "expansion_origin =>") : NULL;
    if (!origin)
        return read;
    read.polynomial.expansion_origin = strtod(origin + strlen("expansion_origin =>"), NULL);
    int count = read_numbers(at, "coefficients", read.polynomial.coefficients);
    read.polynomial.order = (unsigned)(count - 1);
    read.is_there = count > 0;
    return read;
}

static Setting read_setting(const char *text)
{
    double range;
    return (Setting){.subdevice = (unsigned)strtol(text, NULL, 10),
                     .range = read_numbers(text, "ranges", &range) ? (int)range : -1,
                     .to_phys = read_converter(text, "softcal_to_phys"),
                     .from_phys = read_converter(text, "softcal_from_phys")};
}

static comedi_calibration_t *read_settings(char *text)
{
    static const char KEY[] = "subdevice =>";
    comedi_calibration_t *calibration = calloc(1, sizeof *calibration);
    char *at = strstr(text, KEY);
    while (at && calibration->count < SETTINGS) {
        char *begin = at + strlen(KEY), *next = strstr(begin, KEY);
        if (next)
            *next = '\0';
        calibration->settings[calibration->count++] = read_setting(begin);
        at = next;
    }
    if (calibration->count)
        return calibration;
    free(calibration);
    return NULL;
}

EXPORT comedi_calibration_t *comedi_parse_calibration_file(const char *path)
{
    static char text[16384];
    FILE *file = fopen(path, "re");
    if (!file)
        return NULL;
    text[fread(text, 1, sizeof text - 1, file)] = '\0';
    fclose(file);
    return read_settings(text);
}

EXPORT void comedi_cleanup_calibration(comedi_calibration_t *calibration)
{
    free(calibration);
}

/* The caller frees it. */
EXPORT char *comedi_get_default_calibration_path(comedi_t *device)
{
    (void)device;
    char path[sizeof registers_path + sizeof ".calibration"];
    snprintf(path, sizeof path, "%s.calibration", registers_path);
    return strdup(path);
}

/* A straight line is turned round where only the other direction is known. */
static bool turn_round(const comedi_polynomial_t *known, comedi_polynomial_t *wanted)
{
    if (known->order != 1)
        return false;
    *wanted = (comedi_polynomial_t){{known->expansion_origin, 1.0 / known->coefficients[1]},
                                    known->coefficients[0], 1};
    return true;
}

EXPORT int comedi_get_softcal_converter(unsigned subdevice, unsigned channel, unsigned range,
                                        enum comedi_conversion_direction direction,
                                        const comedi_calibration_t *calibration,
                                        comedi_polynomial_t *polynomial)
{
    (void)channel;
    for (const Setting *s = calibration->settings; s < calibration->settings + calibration->count;
         s++) {
        if (s->subdevice != subdevice || (s->range >= 0 && s->range != (int)range))
            continue;
        const Converter *wanted = direction == COMEDI_TO_PHYSICAL ? &s->to_phys : &s->from_phys;
        const Converter *other = direction == COMEDI_TO_PHYSICAL ? &s->from_phys : &s->to_phys;
        if (wanted->is_there)
            *polynomial = wanted->polynomial;
        return wanted->is_there || turn_round(&other->polynomial, polynomial) ? 0 : -1;
    }
    return -1;
}
