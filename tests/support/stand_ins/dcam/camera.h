/* State of the fake cameras: settings, ring, clock and faults. */
#ifndef SVWFS_CAMERA_H
#define SVWFS_CAMERA_H

#include <pthread.h>
#include <stdbool.h>

#include "dcamapi.h"

enum { CAMERAS = 2, SENSOR_PX = 512, PROPERTIES = 128, ELEMENTS = 3, RING_FRAMES = 65536 };

typedef struct {
    int32_t number; /* frame number since start, including lost frames */
    double end_s;   /* of its exposure */
    bool is_black;  /* the EM gain was protected */
} Slot;

struct Wait {
    HDCAM camera; /* NULL when closed */
    bool is_waiting, is_aborted;
};

struct Camera {
    const char *serial;
    bool is_open, has_stopped_itself, is_loss_untold;
    double values[PROPERTIES][ELEMENTS];
    int32_t ring_frames; /* 0 without a buffer */
    Slot *ring;
    bool is_capturing, is_snap;
    int32_t exposed, transferred; /* frames since the start */
    int32_t overexposed_frames;
    double exposure_end_s; /* of the current frame; infinite while waiting for a trigger */
    struct Wait wait;
};

typedef enum { PLUGGED, UNPLUGGED, UNPLUGGED_SILENTLY, UNPLUGGED_HALFWAY } Plug;

#define EACH_FUNCTION(do)                                                                                              \
    do(dcamapi_init) do(dcamapi_uninit) do(dcamdev_open) do(dcamdev_close) do(dcamdev_getstring) do(dcamprop_getattr)  \
    do(dcamprop_getvalue) do(dcamprop_setgetvalue) do(dcamprop_queryvalue) do(dcamprop_getnextid) do(dcamprop_getname) \
    do(dcamprop_getvaluetext) do(dcambuf_alloc) do(dcambuf_release) do(dcambuf_copyframe) do(dcamcap_start)            \
    do(dcamcap_stop) do(dcamcap_status) do(dcamcap_transferinfo) do(dcamwait_open)             \
    do(dcamwait_close) do(dcamwait_start) do(dcamwait_abort)
#define ENUMERATED(name) F_##name,
typedef enum { EACH_FUNCTION(ENUMERATED) FUNCTIONS } Function;

/* Global state behind one lock; `changed` wakes the waiting calls. */
typedef struct {
    pthread_mutex_t lock;
    pthread_cond_t changed;
    double speed, offset_s, origin_s; /* cameras' clock relative to real time; at speed 0 it jumps */
    int32_t sessions, present;
    bool is_held, is_stalled, is_overexposed, has_cooler_trouble, rounds;
    bool has_failed_init;   /* until dcamapi_uninit every init fails */
    bool answers_while_busy; /* SYSTEM_ALIVE and modes, which Hamamatsu's manual says it denies */
    bool hides_em;          /* the EM properties exist only with the EM amplifier */
    Plug plug, plug_then;
    double unplug_at_s;
    int32_t to_lose;
    struct { int32_t code, times, after; } failing[FUNCTIONS];
    int32_t slow_ms[FUNCTIONS], calls[FUNCTIONS];
    int32_t removed[PROPERTIES], removed_count;
    int32_t refused_id, refused_code;
    int32_t stepped_id, step; /* another step of this property */
    struct Camera cameras[CAMERAS];
} World;

extern World world;

/* clock.c: all with the lock held */
double now_s(void);
double machine_s(void);
double patience_s(void); /* clock of timeouts: real time, or the cameras' if that one jumps */
void pass_time(double until_s, double limit_s);
void spend(int32_t duration_ms);

/* faults.c */
int32_t enter(Function function);
int32_t enter_camera(Function function, HDCAM camera);
int32_t leave(int32_t code);
void follow_time(void);
void power_on(struct Camera *camera);

/* properties.c */
void default_properties(struct Camera *camera);
double value_of(const struct Camera *camera, int32_t id);
bool is_em(const struct Camera *camera);
double frame_period_s(const struct Camera *camera);
void frame_shape(const struct Camera *camera, int32_t *rows, int32_t *columns);

/* capture.c */
void advance(struct Camera *camera);
void end_capture(struct Camera *camera);
void release_ring(struct Camera *camera);
bool is_triggered(const struct Camera *camera);

#endif
