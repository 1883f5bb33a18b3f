/* Entry and exit of every interface function, and the test control, stand_in_*. */
#include <math.h>
#include <string.h>

#include "camera.h"

World world = {.lock = PTHREAD_MUTEX_INITIALIZER};

#define NAMED(name) #name,
static const char *const NAMES[] = {EACH_FUNCTION(NAMED)};

/* Advance the cameras to the present, and pull the plug when due, even if it was pulled in another way. */
void follow_time(void) {
    double moment_s = now_s();
    for (int i = 0; i < CAMERAS; i++) advance(&world.cameras[i]);
    if (moment_s >= world.unplug_at_s) {
        world.plug = world.plug_then;
        world.unplug_at_s = INFINITY;
    }
}

int32_t enter(Function function) {
    pthread_mutex_lock(&world.lock);
    world.calls[function]++;
    if (world.slow_ms[function] && function != F_dcambuf_copyframe) spend(world.slow_ms[function]);
    follow_time();
    if (world.failing[function].times > 0 && world.failing[function].after-- <= 0) {
        world.failing[function].times--;
        return world.failing[function].code;
    }
    bool needs_session = function != F_dcamapi_init && function != F_dcamapi_uninit;
    return needs_session && !world.sessions ? UNLOADED : SUCCESS;
}

static bool writes(Function function) {
    return function == F_dcamprop_setgetvalue || function == F_dcambuf_alloc || function == F_dcamcap_start ||
           function == F_dcamcap_stop;
}

int32_t enter_camera(Function function, HDCAM camera) {
    int32_t code = enter(function);
    if (code < 0) return code;
    bool is_known = false;
    for (int i = 0; i < CAMERAS; i++) is_known |= camera == &world.cameras[i];
    if (!is_known || !camera->is_open) return INVALIDHANDLE;
    if (function == F_dcamdev_close || function == F_dcambuf_release) return SUCCESS;
    if (world.plug == UNPLUGGED && function != F_dcamwait_abort) return NOCONNECTION;
    if (world.plug == UNPLUGGED_HALFWAY && writes(function)) return FAILWRITECAMERA;
    if (world.plug == UNPLUGGED_HALFWAY && function == F_dcamprop_getvalue) return FAILREADCAMERA;
    return code;
}

int32_t leave(int32_t code) {
    pthread_mutex_unlock(&world.lock);
    return code;
}

void power_on(struct Camera *camera) {
    end_capture(camera);
    release_ring(camera);
    camera->is_open = false;
    camera->wait = (struct Wait){0};
    default_properties(camera);
}

static Function function_named(const char *name) {
    Function function = 0;
    while (function < FUNCTIONS && strcmp(name, NAMES[function]) != 0) function++;
    return function;
}

static void lock(void) {
    pthread_mutex_lock(&world.lock);
    follow_time();
}

static void unlock(void) {
    pthread_cond_broadcast(&world.changed);
    pthread_mutex_unlock(&world.lock);
}

/* Initial state: one camera, plugged in, no faults, no session; time 0. */
DCAM_EXPORT void stand_in_reset(double speed) {
    static const char *const SERIALS[CAMERAS] = {"S/N: 000123", "S/N: 000456"};
    pthread_mutex_lock(&world.lock);
    world.speed = speed;
    world.offset_s = 0.0;
    world.origin_s = machine_s();
    world.sessions = 0;
    world.present = 1;
    world.is_held = world.is_stalled = world.is_overexposed = world.has_cooler_trouble = false;
    world.rounds = true;
    world.has_failed_init = world.answers_while_busy = world.hides_em = false;
    world.plug = PLUGGED;
    world.unplug_at_s = INFINITY;
    world.to_lose = 0;
    world.removed_count = 0;
    world.refused_id = world.stepped_id = 0;
    memset(world.failing, 0, sizeof world.failing);
    memset(world.slow_ms, 0, sizeof world.slow_ms);
    memset(world.calls, 0, sizeof world.calls);
    for (int i = 0; i < CAMERAS; i++) {
        world.cameras[i].serial = SERIALS[i];
        power_on(&world.cameras[i]);
    }
    unlock();
}

/* Without test control, the library acts as a camera in real time. */
__attribute__((constructor)) static void begin(void) {
    pthread_condattr_t attributes;
    pthread_condattr_init(&attributes);
    pthread_condattr_setclock(&attributes, CLOCK_MONOTONIC);
    pthread_cond_init(&world.changed, &attributes);
    pthread_condattr_destroy(&attributes);
    stand_in_reset(1.0);
}

DCAM_EXPORT double stand_in_now(void) {
    pthread_mutex_lock(&world.lock);
    double moment_s = now_s();
    pthread_mutex_unlock(&world.lock);
    return moment_s;
}

DCAM_EXPORT void stand_in_advance(double duration_s) {
    lock();
    world.offset_s += duration_s;
    follow_time();
    unlock();
}

#define SETTER(name, change)                                                                                           \
    DCAM_EXPORT void stand_in_##name(int32_t value) {                                                                  \
        lock();                                                                                                        \
        change;                                                                                                        \
        unlock();                                                                                                      \
    }
SETTER(cameras, world.present = value)
SETTER(held, world.is_held = value)        /* by another program */
SETTER(stall, world.is_stalled = value)    /* no frames, without any other fault */
SETTER(lose, world.to_lose += value)       /* the next frames, before transfer */
SETTER(overexpose, world.is_overexposed = value)
SETTER(rounds, world.rounds = value)       /* a value between two steps, or refuses it */
SETTER(cooler_trouble, world.has_cooler_trouble = value)
SETTER(answers_while_busy, world.answers_while_busy = value)
SETTER(hides_em, world.hides_em = value)

/* Pull the plug, after some time, in one of three ways. */
DCAM_EXPORT void stand_in_unplug(int32_t plug, double after_s) {
    lock();
    world.plug_then = (Plug)plug;
    world.unplug_at_s = now_s() + after_s;
    follow_time();
    unlock();
}

/* Put the plug back; handles opened before stay invalid. */
DCAM_EXPORT void stand_in_plug_in(void) {
    lock();
    world.plug = PLUGGED;
    world.unplug_at_s = INFINITY;
    for (int i = 0; i < CAMERAS; i++) power_on(&world.cameras[i]);
    unlock();
}

/* Stop the capture from the camera's side. */
DCAM_EXPORT void stand_in_stop(void) {
    lock();
    for (int i = 0; i < CAMERAS; i++) {
        world.cameras[i].has_stopped_itself = world.cameras[i].is_capturing;
        end_capture(&world.cameras[i]);
    }
    unlock();
}

/* Make a function return an error `times` times, after `after` successes. */
DCAM_EXPORT int32_t stand_in_fail(const char *name, int32_t code, int32_t times, int32_t after) {
    Function function = function_named(name);
    if (function == FUNCTIONS) return INVALIDPARAM;
    lock();
    world.failing[function].code = code;
    world.failing[function].times = times;
    world.failing[function].after = after;
    unlock();
    return SUCCESS;
}

DCAM_EXPORT int32_t stand_in_slow(const char *name, int32_t duration_ms) {
    Function function = function_named(name);
    if (function == FUNCTIONS) return INVALIDPARAM;
    lock();
    world.slow_ms[function] = duration_ms;
    unlock();
    return SUCCESS;
}

/* Count the calls of a function since the reset. */
DCAM_EXPORT int32_t stand_in_calls(const char *name) {
    Function function = function_named(name);
    return function == FUNCTIONS ? INVALIDPARAM : world.calls[function];
}

/* Remove this property. */
DCAM_EXPORT void stand_in_remove(int32_t id) {
    lock();
    if (world.removed_count < PROPERTIES) world.removed[world.removed_count++] = id;
    unlock();
}

/* Make writing this property fail, until another one is named. */
DCAM_EXPORT void stand_in_refuse(int32_t id, int32_t code) {
    lock();
    world.refused_id = id;
    world.refused_code = code;
    unlock();
}

/* Give this property another step. */
DCAM_EXPORT void stand_in_step(int32_t id, int32_t step) {
    lock();
    world.stepped_id = id;
    world.step = step;
    unlock();
}

/* External trigger; ignored during an exposure. */
DCAM_EXPORT void stand_in_trigger(void) {
    lock();
    for (int i = 0; i < CAMERAS; i++) {
        struct Camera *camera = &world.cameras[i];
        if (camera->is_capturing && isinf(camera->exposure_end_s))
            camera->exposure_end_s = now_s() + frame_period_s(camera);
    }
    unlock();
}
