/* dcamwait_*: only what happens during a wait is an event. */
#include <math.h>

#include "camera.h"

int32_t dcamwait_open(DCAMWAIT_OPEN *param) {
    if (!param) return INVALIDPARAM;
    int32_t code = enter_camera(F_dcamwait_open, param->hdcam);
    if (code < 0) return leave(code);
    if (param->size != sizeof *param) return leave(INVALIDPARAM);
    param->hdcam->wait = (struct Wait){.camera = param->hdcam};
    param->hwait = &param->hdcam->wait;
    param->supportevent = EVENT_FRAMEREADY | EVENT_STOPPED;
    return leave(code);
}

static int32_t enter_wait(Function function, HDCAMWAIT hwait) {
    for (int i = 0; i < CAMERAS; i++)
        if (hwait == &world.cameras[i].wait && hwait->camera) return enter_camera(function, hwait->camera);
    int32_t code = enter(function);
    return code < 0 ? code : INVALIDWAITHANDLE;
}

int32_t dcamwait_close(HDCAMWAIT hwait) {
    int32_t code = enter_wait(F_dcamwait_close, hwait);
    if (code == INVALIDWAITHANDLE) return leave(code);
    hwait->camera = NULL;
    pthread_cond_broadcast(&world.changed);
    return leave(code);
}

int32_t dcamwait_abort(HDCAMWAIT hwait) {
    int32_t code = enter_wait(F_dcamwait_abort, hwait);
    if (code > 0 && hwait->is_waiting) { /* no effect without a waiting call */
        hwait->is_aborted = true;
        pthread_cond_broadcast(&world.changed);
    }
    return leave(code);
}

/* Result that ends the wait now, or 0. */
static int32_t event(HDCAMWAIT hwait, int32_t before, int32_t mask, int32_t *happened) {
    struct Camera *camera = hwait->camera;
    if (!camera || hwait->is_aborted) return ABORT;
    if (world.plug == UNPLUGGED) return NOCONNECTION;
    if (camera->is_loss_untold) {
        camera->is_loss_untold = false;
        return LOSTFRAME;
    }
    if (mask & EVENT_FRAMEREADY && camera->transferred != before) *happened = EVENT_FRAMEREADY;
    else if (mask & EVENT_STOPPED && !camera->is_capturing) *happened = EVENT_STOPPED;
    else return 0;
    return SUCCESS;
}

int32_t dcamwait_start(HDCAMWAIT hwait, DCAMWAIT_START *param) {
    int32_t code = enter_wait(F_dcamwait_start, hwait);
    if (code < 0) return leave(code);
    if (!param || param->size != sizeof *param || !param->eventmask) return leave(INVALIDPARAM);
    struct Camera *camera = hwait->camera;
    bool is_endless = (uint32_t)param->timeout == 0x80000000u;
    double limit_s = is_endless ? INFINITY : patience_s() + 1e-3 * param->timeout;
    int32_t before = camera->transferred;
    hwait->is_waiting = true;
    while (!(code = event(hwait, before, param->eventmask, &param->eventhappened)) && patience_s() < limit_s) {
        bool is_exposing = camera->is_capturing && !world.is_stalled && world.plug == PLUGGED;
        pass_time(fmin(is_exposing ? camera->exposure_end_s : INFINITY, world.unplug_at_s), limit_s);
        follow_time();
    }
    hwait->is_waiting = hwait->is_aborted = false;
    return leave(code ? code : TIMEOUT);
}
