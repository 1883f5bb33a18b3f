/* Ring buffer, and the frames that the sensor writes into it over time. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "camera.h"
#include "property_ids.h"

bool is_triggered(const struct Camera *camera) { return value_of(camera, TRIGGERSOURCE) != TRIGGERSOURCE_INTERNAL; }

static bool is_protected(struct Camera *camera) {
    if (!world.is_overexposed || !is_em(camera)) {
        camera->overexposed_frames = 0;
        return false;
    }
    camera->overexposed_frames++;
    return value_of(camera, EMGAINPROTECT_MODE) == MODE_ON &&
           camera->overexposed_frames > value_of(camera, EMGAINPROTECT_AFTERFRAMES);
}

/* Advance the camera to the present: each ended exposure is in the ring, or lost. */
void advance(struct Camera *camera) {
    double moment_s = fmin(now_s(), world.unplug_at_s);
    if (!camera->is_capturing || world.plug != PLUGGED) return;
    while (!world.is_stalled && camera->exposure_end_s <= moment_s && camera->is_capturing) {
        Slot slot = {camera->exposed++, camera->exposure_end_s, is_protected(camera)};
        if (world.to_lose > 0) {
            world.to_lose--;
            camera->is_loss_untold = true;
        } else
            camera->ring[camera->transferred++ % camera->ring_frames] = slot;
        camera->exposure_end_s = is_triggered(camera) ? INFINITY : slot.end_s + frame_period_s(camera);
        if (camera->is_snap && camera->transferred == camera->ring_frames) {
            camera->is_capturing = false;
            camera->has_stopped_itself = true;
        }
    }
    if (world.is_stalled && camera->exposure_end_s <= moment_s) /* later it continues from there */
        camera->exposure_end_s = moment_s + frame_period_s(camera);
}

void end_capture(struct Camera *camera) {
    camera->is_capturing = false;
    camera->overexposed_frames = 0;
}

void release_ring(struct Camera *camera) {
    free(camera->ring);
    camera->ring = NULL;
    camera->ring_frames = 0;
}

int32_t dcambuf_alloc(HDCAM h, int32_t framecount) {
    int32_t code = enter_camera(F_dcambuf_alloc, h);
    if (code < 0) return leave(code);
    if (h->ring) return leave(h->is_capturing ? BUSY : NOTSTABLE);
    if (framecount < 1 || framecount > RING_FRAMES) return leave(INVALIDPARAM);
    h->ring = calloc((size_t)framecount, sizeof *h->ring);
    h->ring_frames = framecount;
    return leave(code);
}

int32_t dcambuf_release(HDCAM h, int32_t iKind) {
    (void)iKind;
    int32_t code = enter_camera(F_dcambuf_release, h);
    if (code < 0) return leave(code);
    if (h->is_capturing) return leave(BUSY);
    release_ring(h);
    return leave(code);
}

int32_t dcamcap_start(HDCAM h, int32_t mode) {
    int32_t code = enter_camera(F_dcamcap_start, h);
    if (code < 0) return leave(code);
    if (mode != CAPTURE_SNAP && mode != CAPTURE_SEQUENCE) return leave(INVALIDPARAM);
    if (!h->ring) return leave(NOTREADY);
    if (h->is_capturing) return leave(BUSY);
    h->is_capturing = true;
    h->is_snap = mode == CAPTURE_SNAP;
    h->has_stopped_itself = h->is_loss_untold = false;
    h->exposed = h->transferred = 0;
    h->exposure_end_s = is_triggered(h) ? INFINITY : now_s() + frame_period_s(h);
    return leave(code);
}

int32_t dcamcap_stop(HDCAM h) {
    int32_t code = enter_camera(F_dcamcap_stop, h);
    if (code < 0) return leave(code);
    end_capture(h);
    pthread_cond_broadcast(&world.changed);
    return leave(code);
}

int32_t dcamcap_status(HDCAM h, int32_t *status) {
    int32_t code = enter_camera(F_dcamcap_status, h);
    if (code > 0) *status = h->is_capturing ? STATUS_BUSY : h->ring ? STATUS_READY : STATUS_STABLE;
    return leave(code);
}

int32_t dcamcap_transferinfo(HDCAM h, DCAMCAP_TRANSFERINFO *param) {
    int32_t code = enter_camera(F_dcamcap_transferinfo, h);
    if (code < 0) return leave(code);
    if (!param || param->size != sizeof *param || param->iKind != 0) return leave(INVALIDPARAM);
    if (!h->ring) return leave(NOTREADY);
    param->nFrameCount = h->transferred;
    param->nNewestFrameIndex = h->transferred ? (h->transferred - 1) % h->ring_frames : -1;
    return leave(code);
}

/* Each pixel encodes its frame and place, and no row repeats in another frame, so that mixed frames show:
 * columns 0 and 1 hold the frame number, the rest a permutation of all counts with another start in each row. */
static void draw(const struct Camera *camera, const Slot *slot, int32_t row, uint16_t *pixels, int32_t columns) {
    static uint16_t counts[65536 + SENSOR_PX];
    if (!counts[1])
        for (int32_t i = 0; i < 65536 + SENSOR_PX; i++) counts[i] = (uint16_t)(i * 40503u);
    if (slot->is_black) {
        memset(pixels, 0, 2 * (size_t)columns);
        return;
    }
    bool is_part = value_of(camera, SUBARRAYMODE) == MODE_ON;
    int32_t top = is_part ? (int32_t)value_of(camera, SUBARRAYVPOS) : 0;
    int32_t left = is_part ? (int32_t)value_of(camera, SUBARRAYHPOS) : 0;
    uint32_t start = 257u * (uint32_t)slot->number + 12289u * (uint32_t)(top + row) + (uint32_t)left;
    memcpy(pixels, counts + (start & 0xffff), 2 * (size_t)columns);
    pixels[0] = (uint16_t)slot->number;
    pixels[1] = (uint16_t)(slot->number >> 16);
}

/* Content of a slot. The one after the newest is being overwritten, at worst completely. */
static Slot written(const struct Camera *camera, int32_t index) {
    Slot next = {camera->exposed, 0, false};
    bool is_overwritten = camera->is_capturing && camera->transferred >= camera->ring_frames;
    return is_overwritten && index == camera->transferred % camera->ring_frames ? next : camera->ring[index];
}

/* A slow copy pauses half way down, and may continue in an overwritten slot. */
int32_t dcambuf_copyframe(HDCAM h, DCAMBUF_FRAME *frame) {
    int32_t code = enter_camera(F_dcambuf_copyframe, h);
    if (code < 0) return leave(code);
    int32_t rows, columns;
    if (!h->ring) return leave(NOTREADY);
    frame_shape(h, &rows, &columns);
    if (!frame || frame->size != sizeof *frame || !frame->buf || frame->left || frame->top) return leave(INVALIDPARAM);
    if (frame->width != columns || frame->height != rows || frame->rowbytes < 2 * columns) return leave(INVALIDPARAM);
    if (frame->iFrame < 0 || frame->iFrame >= h->ring_frames || frame->iFrame >= h->transferred)
        return leave(INVALIDFRAMEINDEX);
    Slot first = h->ring[frame->iFrame];
    for (int32_t row = 0; row < rows; row++) {
        if (row == rows / 2 && world.slow_ms[F_dcambuf_copyframe]) {
            spend(world.slow_ms[F_dcambuf_copyframe]);
            follow_time();
            if (!h->ring) return leave(ABORT);
        }
        Slot slot = written(h, frame->iFrame);
        draw(h, &slot, row, (uint16_t *)((char *)frame->buf + (size_t)row * frame->rowbytes), columns);
    }
    frame->timestamp.sec = (uint32_t)first.end_s;
    frame->timestamp.microsec = (int32_t)(1e6 * (first.end_s - floor(first.end_s)));
    frame->framestamp = first.number;
    frame->camerastamp = 0;
    return leave(code);
}
