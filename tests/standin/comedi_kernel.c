/* The kernel below the real libcomedi: preloaded, it answers for the device file of the stand-in
   card with the ioctls of the kernel's public header. The card behind it is that of `comedi.c`. */
#define _GNU_SOURCE
#define EXPORT static __attribute__((unused))
#include "comedi.c"

#include <dlfcn.h>
#include <stdarg.h>
#include <sys/ioctl.h>

#define INTERPOSED __attribute__((visibility("default")))

enum { FILES = 64 };
static comedi_t files[FILES];

static comedi_t *file_of(int descriptor)
{
    for (comedi_t *file = files; file < files + FILES; file++)
        if (file->id && file->file == descriptor)
            return file;
    return NULL;
}

static int open_card(const char *path)
{
    static int64_t last_id;
    int descriptor = open_file(path);
    if (descriptor < 0) {
        errno = -descriptor;
        return -1;
    }
    files[last_id % FILES] = (comedi_t){descriptor, last_id + 1};
    last_id++;
    return descriptor;
}

#define INTERPOSE_OPEN(name)                                                                       \
    INTERPOSED int name(const char *path, int flags, ...)                                          \
    {                                                                                              \
        va_list rest;                                                                              \
        va_start(rest, flags);                                                                     \
        int mode = va_arg(rest, int);                                                              \
        va_end(rest);                                                                              \
        if (strncmp(path, "/dev/comedi", 11) == 0)                                                 \
            return open_card(path);                                                                \
        int (*next)(const char *, int, ...) = dlsym(RTLD_NEXT, #name);                             \
        return next(path, flags, mode);                                                            \
    }

INTERPOSE_OPEN(open)
INTERPOSE_OPEN(open64)

INTERPOSED int close(int descriptor)
{
    comedi_t *file = file_of(descriptor);
    if (file) {
        device_lock();
        for (int resource = 0; resource < RESOURCES; resource++)
            device_release((Resource)resource, file->id);
        device_unlock();
        file->id = 0;
    }
    int (*next)(int) = dlsym(RTLD_NEXT, "close");
    return next(descriptor);
}

static int tell_device(struct comedi_devinfo *info)
{
    *info = (struct comedi_devinfo){.version_code = 0x74c, /* 0.7.76 */
                                    .n_subdevs = COUNT,
                                    .driver_name = "stand_in",
                                    .board_name = "pci-6221",
                                    .read_subdevice = -1,
                                    .write_subdevice = -1};
    return 0;
}

static int tell_subdevices(struct comedi_subdinfo *info)
{
    for (unsigned i = 0; i < COUNT; i++)
        info[i] = (struct comedi_subdinfo){.type = (unsigned)SUBDEVICES[i].type,
                                           .n_chan = (unsigned)SUBDEVICES[i].channels,
                                           .subd_flags = SUBDEVICES[i].flags,
                                           .maxdata = comedi_get_maxdata(NULL, i, 0),
                                           .range_type = i << 24 | (unsigned)count_ranges(i)};
    return 0;
}

static int tell_ranges(const struct comedi_rangeinfo *asked)
{
    struct comedi_krange *ranges = asked->range_ptr;
    for (unsigned i = 0; i < (asked->range_type & 0xffff); i++) {
        const comedi_range *range = comedi_get_range(NULL, asked->range_type >> 24, 0, i);
        ranges[i] = (struct comedi_krange){(int)lround(range->min * 1e6),
                                           (int)lround(range->max * 1e6), UNIT_volt};
    }
    return 0;
}

/* An instruction for the whole device: the library asks for the time to try the ioctl out. */
static int run_any(const comedi_t *file, const comedi_insn *insn)
{
    return insn->insn == INSN_GTOD ? (int)insn->n : run(file, insn);
}

static int run_any_list(const comedi_t *file, const comedi_insnlist *list)
{
    if (list->n_insns && list->insns->insn == INSN_GTOD)
        return (int)list->n_insns;
    return run_list(file, list);
}

static int answer(const comedi_t *file, unsigned request, void *argument)
{
    switch (request) {
    case COMEDI_LOCK:
        return lock(file, (unsigned)(uintptr_t)argument);
    case COMEDI_UNLOCK:
        return unlock(file, (unsigned)(uintptr_t)argument);
    case COMEDI_CHANINFO: /* nothing depends on the channel */
        return 0;
    }
    if (!argument)
        return -EFAULT;
    switch (request) {
    case COMEDI_DEVINFO:
        return tell_device(argument);
    case COMEDI_SUBDINFO:
        return tell_subdevices(argument);
    case COMEDI_RANGEINFO:
        return tell_ranges(argument);
    case COMEDI_INSN:
        return run_any(file, argument);
    case COMEDI_INSNLIST:
        return run_any_list(file, argument);
    default:
        return -ENOTTY;
    }
}

INTERPOSED int ioctl(int descriptor, unsigned long request, ...)
{
    va_list rest;
    va_start(rest, request);
    void *argument = va_arg(rest, void *);
    va_end(rest);
    comedi_t *file = file_of(descriptor);
    /* Python's close-on-exec is for every file, whatever its driver. */
    if (!file || (unsigned)request == FIOCLEX) {
        int (*next)(int, unsigned long, ...) = dlsym(RTLD_NEXT, "ioctl");
        return next(descriptor, request, argument);
    }
    device_lock();
    int code = answer(file, (unsigned)request, argument);
    device_unlock();
    if (code >= 0)
        return code;
    errno = -code;
    return -1;
}
