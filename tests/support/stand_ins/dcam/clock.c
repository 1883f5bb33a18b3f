/* Cameras' clock: real time, a multiple of it, or jumping to the next awaited event. */
#include <math.h>
#include <time.h>

#include "camera.h"

double machine_s(void) {
    struct timespec time;
    clock_gettime(CLOCK_MONOTONIC, &time);
    return (double)time.tv_sec + 1e-9 * (double)time.tv_nsec;
}

double now_s(void) { return world.offset_s + world.speed * (machine_s() - world.origin_s); }

double patience_s(void) { return world.speed > 0 ? machine_s() : now_s(); }

/* Wait until `until_s` on the cameras' clock, `limit_s` on that of timeouts, or a change. */
void pass_time(double until_s, double limit_s) {
    if (isinf(until_s) && isinf(limit_s)) {
        pthread_cond_wait(&world.changed, &world.lock);
        return;
    }
    if (world.speed <= 0) {
        world.offset_s = fmax(world.offset_s, fmin(until_s, limit_s));
        return;
    }
    double wake_s = fmin(limit_s, machine_s() + (until_s - now_s()) / world.speed);
    double whole_s = floor(wake_s);
    struct timespec wake = {.tv_sec = (time_t)whole_s, .tv_nsec = (long)(1e9 * (wake_s - whole_s))};
    pthread_cond_timedwait(&world.changed, &world.lock, &wake);
}

/* Take time; other threads may call meanwhile. */
void spend(int32_t duration_ms) {
    if (world.speed <= 0) {
        world.offset_s += 1e-3 * duration_ms;
        return;
    }
    struct timespec time = {.tv_sec = duration_ms / 1000, .tv_nsec = duration_ms % 1000 * 1000000L};
    pthread_mutex_unlock(&world.lock);
    nanosleep(&time, NULL);
    pthread_mutex_lock(&world.lock);
}
