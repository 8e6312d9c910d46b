/* Sleeps to absolute deadlines and prints how late it woke: what the host allows any loop.
   sleep_floor PERIOD_US CYCLES -> p50 p99 max in microseconds, and the scheduling it was given. */
#define _GNU_SOURCE
#include <sched.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <time.h>

static int ascending(const void *a, const void *b) {
    double x = *(const double *)a, y = *(const double *)b;
    return (x > y) - (x < y);
}

int main(int argc, char **argv) {
    long period_ns = argc > 1 ? atol(argv[1]) * 1000 : 1000000, cycles = argc > 2 ? atol(argv[2]) : 1000;
    struct sched_param priority = {.sched_priority = 50};
    int fifo = sched_setscheduler(0, SCHED_FIFO, &priority) == 0;
    mlockall(MCL_CURRENT | MCL_FUTURE);
    double *late = malloc(cycles * sizeof *late);
    struct timespec due, now;
    clock_gettime(CLOCK_MONOTONIC, &due);
    for (long k = 0; k < cycles; k++) {
        due.tv_nsec += period_ns;
        while (due.tv_nsec >= 1000000000) { due.tv_nsec -= 1000000000; due.tv_sec++; }
        clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &due, NULL);
        clock_gettime(CLOCK_MONOTONIC, &now);
        late[k] = (now.tv_sec - due.tv_sec) * 1e6 + (now.tv_nsec - due.tv_nsec) / 1e3;
    }
    qsort(late, cycles, sizeof *late, ascending);
    printf("%.0f %.0f %.0f %s\n", late[cycles / 2], late[(long)(cycles * 0.99)], late[cycles - 1],
           fifo ? "SCHED_FIFO" : "SCHED_OTHER");
    return 0;
}
