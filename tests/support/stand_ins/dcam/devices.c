/* Session and opening of cameras. */
#include <stdio.h>
#include <string.h>

#include "camera.h"

int32_t dcamapi_init(DCAMAPI_INIT *param) {
    int32_t code = enter(F_dcamapi_init);
    if (!param || param->size != sizeof *param) return leave(INVALIDPARAM);
    if (world.sessions) return leave(BUSY); /* one session per process */
    if (code > 0 && (world.has_failed_init || world.present == 0 || world.plug != PLUGGED)) code = NOCAMERA;
    world.has_failed_init = code < 0;
    if (code < 0) return leave(code);
    world.sessions = 1;
    param->iDeviceCount = world.present;
    return leave(SUCCESS);
}

int32_t dcamapi_uninit(void) {
    int32_t code = enter(F_dcamapi_uninit);
    if (code > 0) {
        world.sessions = 0;
        world.has_failed_init = false;
        for (int i = 0; i < CAMERAS; i++) power_on(&world.cameras[i]);
        pthread_cond_broadcast(&world.changed);
    }
    return leave(code);
}

int32_t dcamdev_open(DCAMDEV_OPEN *param) {
    int32_t code = enter(F_dcamdev_open);
    if (code < 0) return leave(code);
    if (!param || param->size != sizeof *param) return leave(INVALIDPARAM);
    if (param->index < 0 || param->index >= world.present) return leave(INVALIDCAMERA);
    if (world.plug != PLUGGED) return leave(NOCAMERA);
    struct Camera *camera = &world.cameras[param->index];
    if (world.is_held || camera->is_open) return leave(FAILOPENCAMERA);
    camera->is_open = true;
    param->hdcam = camera;
    return leave(SUCCESS);
}

int32_t dcamdev_close(HDCAM h) {
    int32_t code = enter_camera(F_dcamdev_close, h);
    if (code > 0) {
        power_on(h); /* it forgets its settings */
        pthread_cond_broadcast(&world.changed);
    }
    return leave(code);
}

static const char *string_of(const struct Camera *camera, int32_t id) {
    switch (id) {
    case IDSTR_BUS: return "IEEE1394";
    case IDSTR_CAMERAID: return camera->serial;
    case IDSTR_VENDOR: return "Hamamatsu";
    case IDSTR_MODEL: return "C9100-23B";
    case IDSTR_CAMERAVERSION: return "1.00.A";
    case IDSTR_DRIVERVERSION: return "0.1";
    case IDSTR_MODULEVERSION: return "svwfs stand-in";
    case IDSTR_DCAMAPIVERSION: return "4.00";
    default: return NULL;
    }
}

/* Takes the handle of an open camera, or an index. */
int32_t dcamdev_getstring(HDCAM h, DCAMDEV_STRING *param) {
    int32_t code;
    struct Camera *camera = h;
    if ((intptr_t)h < CAMERAS) {
        code = enter(F_dcamdev_getstring);
        if (code > 0 && (intptr_t)h >= world.present) code = INVALIDCAMERA;
        camera = &world.cameras[(intptr_t)h];
    } else
        code = enter_camera(F_dcamdev_getstring, h);
    if (code < 0) return leave(code);
    if (!param || param->size != sizeof *param || !param->text || param->textbytes < 1) return leave(INVALIDPARAM);
    const char *text = string_of(camera, param->iString);
    if (!text) return leave(INVALIDPARAM);
    snprintf(param->text, (size_t)param->textbytes, "%s", text);
    return leave(SUCCESS);
}
