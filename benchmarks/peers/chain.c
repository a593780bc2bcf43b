/* The loop as a chain of processes over ImageStreamIO, one stage of the control step each, as CACAO runs it.

   chain ROLE FOLDER RATE_HZ FRAMES PROCESSOR PRIORITY, with MILK_SHM_DIR=FOLDER

   Files of FOLDER are those of shared.py; sizes and constants are given by -D. The cnt1 of a stream is the number of the
   frame that it was made from. Compiled with ImageStreamIO.c of github.com/milk-org/ImageStreamIO. */

#define _GNU_SOURCE
#include <fcntl.h>
#include <math.h>
#include <sched.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <time.h>
#include <unistd.h>

#include "ImageStreamIO.h"

enum { ROWS = 4 }; /* rows of the product that are summed in parallel */
_Static_assert(MODES % ROWS == 0, "MODES must be a multiple of ROWS");

static const uint16_t *frames;
static const float *I0, *R, *to_actuators;
static float *last_actuators;
static IMAGE input, output;

static void check(int good, const char *what)
{
    if (!good) {
        perror(what);
        exit(1);
    }
}

static int64_t now_ns(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return now.tv_sec * INT64_C(1000000000) + now.tv_nsec;
}

static void *shared_file(const char *name)
{
    struct stat found;
    int file = open(name, O_RDWR);
    check(file >= 0 && fstat(file, &found) == 0, name);
    void *memory = mmap(NULL, found.st_size, PROT_READ | PROT_WRITE, MAP_SHARED | MAP_POPULATE, file, 0);
    check(memory != MAP_FAILED, name);
    return memory;
}

static void acquire(void)
{
    for (int pixel = 0; pixel < PIXELS; pixel++)
        output.array.F[pixel] = input.array.UI16[pixel] - I0[pixel];
}

static void product(void)
{
    const float *signal = input.array.F;
    for (int mode = 0; mode < MODES; mode += ROWS) {
        const float *row = R + mode * PIXELS;
        float sum[ROWS] = {0};
        for (int pixel = 0; pixel < PIXELS; pixel++)
            for (int each = 0; each < ROWS; each++)
                sum[each] += row[each * PIXELS + pixel] * signal[pixel];
        memcpy(output.array.F + mode, sum, sizeof sum);
    }
}

static void filter(void)
{
    float *command = output.array.F;
    for (int mode = 0; mode < MODES; mode++) {
        float unlimited = (1 - (float)LEAK) * command[mode] - (float)GAIN * input.array.F[mode];
        command[mode] = fminf(fmaxf(unlimited, -(float)LIMIT_NM), (float)LIMIT_NM);
    }
}

static void actuators(void)
{
    for (int actuator = 0; actuator < ACTUATORS; actuator++) {
        float sum = 0;
        for (int mode = 0; mode < MODES; mode++)
            sum += to_actuators[actuator * MODES + mode] * input.array.F[mode];
        output.array.F[actuator] = sum;
    }
}

static void mirror(void) { memcpy(last_actuators, input.array.F, ACTUATORS * sizeof *last_actuators); }

/* Streams that a role reads and writes, its array of times, and its work on each frame. */
static const struct role {
    const char *name, *reads, *writes;
    uint8_t type;
    uint32_t size[2];
    const char *time_stamps;
    void (*step)(void);
} ROLES[] = {
    {"source", NULL, "camera", _DATATYPE_UINT16, {SIDE, SIDE}, "published", NULL},
    {"acquire", "camera", "signal", _DATATYPE_FLOAT, {SIDE, SIDE}, NULL, acquire},
    {"product", "signal", "error", _DATATYPE_FLOAT, {MODES, 1}, NULL, product},
    {"filter", "error", "command", _DATATYPE_FLOAT, {MODES, 1}, NULL, filter},
    {"actuators", "command", "surface", _DATATYPE_FLOAT, {MIRROR_SIDE, MIRROR_SIDE}, "commanded", actuators},
    {"mirror", "surface", NULL, 0, {0, 0}, "received", mirror},
};

static void send_frames(double rate_hz, long count, int64_t *published)
{
    int64_t *due = shared_file("due");
    while (access("go", F_OK) != 0)
        usleep(20000);
    int64_t begun = now_ns();
    for (long number = 1; number <= count; number++) {
        due[number] = begun + llround(number * 1e9 / rate_hz);
        struct timespec until = {due[number] / 1000000000, due[number] % 1000000000};
        clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &until, NULL);
        published[number] = now_ns();
        output.md->write = 1;
        memcpy(output.array.UI16, frames + number % DISTINCT_FRAMES * PIXELS, PIXELS * sizeof *frames);
        output.md->cnt1 = number;
        ImageStreamIO_UpdateIm(&output);
    }
    usleep(50000); /* wait for the last command */
}

static void answer(const struct role *role, int semaphore, int64_t *time_stamps)
{
    for (;;) {
        while (ImageStreamIO_semwait(&input, semaphore) != 0)
            ;
        int64_t number = input.md->cnt1;
        if (role->writes)
            output.md->write = 1;
        role->step();
        if (role->writes) {
            output.md->cnt1 = number;
            ImageStreamIO_UpdateIm(&output);
        }
        if (time_stamps)
            time_stamps[number] = now_ns();
    }
}

int main(int count, char **arguments)
{
    check(count == 7, "ROLE FOLDER RATE_HZ FRAMES PROCESSOR PRIORITY");
    const struct role *role = ROLES;
    while (strcmp(role->name, arguments[1]) != 0)
        role++;
    cpu_set_t processors;
    CPU_ZERO(&processors);
    CPU_SET(atoi(arguments[5]), &processors);
    struct sched_param priority = {atoi(arguments[6])};
    check(chdir(arguments[2]) == 0, arguments[2]);
    check(sched_setaffinity(0, sizeof processors, &processors) == 0, "sched_setaffinity");
    check(sched_setscheduler(0, atoi(arguments[6]) ? SCHED_FIFO : SCHED_OTHER, &priority) == 0, "sched_setscheduler");

    frames = shared_file("frames");
    I0 = shared_file("I0");
    R = shared_file("R");
    to_actuators = shared_file("to_actuators");
    last_actuators = shared_file("actuators");
    int64_t *time_stamps = role->time_stamps ? shared_file(role->time_stamps) : NULL;
    int semaphore = 0;
    uint32_t size[2] = {role->size[0], role->size[1]};
    if (role->writes)
        check(ImageStreamIO_createIm(&output, role->writes, 2, size, role->type, 1, 0, 0) == 0, role->writes);
    if (role->reads) {
        check(ImageStreamIO_openIm(&input, role->reads) == 0, role->reads);
        semaphore = ImageStreamIO_getsemwaitindex(&input, 0);
        ImageStreamIO_semflush(&input, semaphore);
    }
    char ready[64];
    snprintf(ready, sizeof ready, "ready-%s", role->name);
    check(creat(ready, 0600) >= 0, ready);
    if (role->reads)
        answer(role, semaphore, time_stamps);
    else
        send_frames(atof(arguments[3]), atol(arguments[4]), time_stamps);
    return 0;
}
