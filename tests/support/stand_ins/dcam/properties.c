/* Reading and writing of properties, within the limits and states of the property sheet. */
#include <math.h>
#include <stdio.h>
#include <string.h>

#include "camera.h"
#include "property_ids.h"
#include "property_sheet.h"

enum { ELEMENT_STEP = 0x100 };
static const double LOWEST_EM_GAIN = 4, HIGHEST_EM_GAIN = 1200;

typedef struct {
    double minimum, maximum, step, initial;
} Limits;

static bool is_absent(const struct Camera *camera, int32_t id) {
    for (int32_t i = 0; i < world.removed_count; i++)
        if (world.removed[i] == id) return true;
    bool is_of_em_gain = id >= SENSITIVITY && id <= MEASURED_SENSITIVITY;
    return world.hides_em && is_of_em_gain && !is_em(camera);
}

/* The property of an id, or NULL, and its array element. */
static const Property *find(const struct Camera *camera, int32_t id, int32_t *element) {
    for (const Property *property = SHEET; property < SHEET + SHEET_LENGTH; property++)
        for (*element = 0; *element < property->elements; ++*element)
            if (property->id + ELEMENT_STEP * *element == id) return is_absent(camera, property->id) ? NULL : property;
    return NULL;
}

static double stored(const struct Camera *camera, int32_t id) {
    int32_t i = 0;
    while (SHEET[i].id != id) i++;
    return camera->values[i][0];
}

static void store(struct Camera *camera, int32_t id, double value) {
    int32_t i = 0;
    while (SHEET[i].id != id) i++;
    camera->values[i][0] = value;
}

bool is_em(const struct Camera *camera) { return stored(camera, CCDMODE) == CCDMODE_EMCCD; }

static double shortest_exposure_s(const struct Camera *camera) {
    int32_t speed = is_em(camera) ? (int32_t)stored(camera, READOUTSPEED) : 1;
    return speed == 3 ? 0.0139 : speed == 2 ? 0.02713 : 0.42147;
}

static double longest_exposure_s(const struct Camera *camera) { /* only the fastest read-out limits it */
    return shortest_exposure_s(camera) == 0.0139 ? 1.0 : 7200.0;
}

static Limits limits(const struct Camera *camera, const Property *property) {
    Limits found = {property->minimum, property->maximum, property->step, property->initial};
    if (property->choices) {
        const Choice *last = property->choices;
        while (last[1].text) last++;
        found.minimum = property->choices->value;
        found.maximum = last->value;
        found.step = 1;
    }
    if (property->id == world.stepped_id) found.step = world.step;
    switch (property->id) {
    case READOUTSPEED: return is_em(camera) ? found : (Limits){1, 1, 0, 1};
    case CONTRASTGAIN: return is_em(camera) ? found : (Limits){1, 5, 1, 1};
    case EXPOSURETIME:
        found.minimum = found.initial = shortest_exposure_s(camera);
        found.maximum = longest_exposure_s(camera);
        return found;
    case SENSITIVITY:
        if (stored(camera, DIRECTEMGAIN_MODE) == MODE_ON)
            found = (Limits){LOWEST_EM_GAIN, HIGHEST_EM_GAIN, 1, LOWEST_EM_GAIN};
        return found;
    default: return found;
    }
}

double frame_period_s(const struct Camera *camera) {
    return fmax(stored(camera, EXPOSURETIME), shortest_exposure_s(camera));
}

void frame_shape(const struct Camera *camera, int32_t *rows, int32_t *columns) {
    bool is_part = stored(camera, SUBARRAYMODE) == MODE_ON;
    int32_t binning = (int32_t)stored(camera, BINNING);
    *rows = (is_part ? (int32_t)stored(camera, SUBARRAYVSIZE) : SENSOR_PX) / binning;
    *columns = (is_part ? (int32_t)stored(camera, SUBARRAYHSIZE) : SENSOR_PX) / binning;
}

static double em_gain(const struct Camera *camera) {
    double sensitivity = stored(camera, SENSITIVITY);
    if (stored(camera, DIRECTEMGAIN_MODE) == MODE_ON) return sensitivity;
    return LOWEST_EM_GAIN * pow(HIGHEST_EM_GAIN / LOWEST_EM_GAIN, sensitivity / 255);
}

static double warning_status(const struct Camera *camera) {
    if (!camera->overexposed_frames) return EMGAINWARNING_NORMAL;
    bool is_protected = stored(camera, EMGAINPROTECT_MODE) == MODE_ON &&
                        camera->overexposed_frames > stored(camera, EMGAINPROTECT_AFTERFRAMES);
    return is_protected ? EMGAINWARNING_PROTECTED : EMGAINWARNING_WARNING;
}

/* Stored or live value. */
double value_of(const struct Camera *camera, int32_t id) {
    int32_t rows, columns;
    frame_shape(camera, &rows, &columns);
    switch (id) {
    case SYSTEM_ALIVE: return world.plug == PLUGGED ? ALIVE_ONLINE : ALIVE_OFFLINE;
    case SENSORTEMPERATURE: return world.has_cooler_trouble ? 12.5 : -65;
    case SENSORCOOLERSTATUS: return world.has_cooler_trouble ? COOLER_ERROR1 : COOLER_READY;
    case EMGAINWARNING_STATUS: return warning_status(camera);
    case MEASURED_SENSITIVITY: return is_em(camera) && camera->transferred ? em_gain(camera) : 0;
    case TIMING_READOUTTIME: return shortest_exposure_s(camera);
    case TIMING_CYCLICTRIGGERPERIOD:
    case TIMING_MINTRIGGERINTERVAL:
    case INTERNAL_FRAMEINTERVAL: return frame_period_s(camera);
    case INTERNALFRAMERATE: return 1 / frame_period_s(camera);
    case IMAGE_WIDTH: return columns;
    case IMAGE_HEIGHT: return rows;
    case IMAGE_ROWBYTES:
    case BUFFER_ROWBYTES: return 2 * columns;
    case IMAGE_FRAMEBYTES:
    case BUFFER_FRAMEBYTES: return 2 * columns * rows;
    default: return stored(camera, id);
    }
}

void default_properties(struct Camera *camera) {
    for (int32_t i = 0; i < SHEET_LENGTH; i++)
        for (int32_t element = 0; element < ELEMENTS; element++) camera->values[i][element] = SHEET[i].initial;
}

static const Choice *choice(const Property *property, double value) {
    for (const Choice *each = property->choices; each && each->text; each++)
        if (each->value == value) return each;
    return NULL;
}

/* Round the value to an allowed one, or return an error. */
static int32_t take(const struct Camera *camera, const Property *property, double *value) {
    if (property->choices) return choice(property, *value) ? SUCCESS : INVALIDVALUE;
    Limits allowed = limits(camera, property);
    if (!(*value >= allowed.minimum && *value <= allowed.maximum)) return OUTOFRANGE;
    if (allowed.step > 0) {
        double rounded = allowed.minimum + round((*value - allowed.minimum) / allowed.step) * allowed.step;
        if (allowed.step < 1) rounded = round(*value * round(1 / allowed.step)) / round(1 / allowed.step); /* as typed */
        if (!world.rounds && fabs(rounded - *value) > 1e-6 * allowed.step) return INVALIDVALUE;
        *value = rounded;
    }
    return SUCCESS;
}

/* A subarray must lie on the sensor after every write. */
static bool fits(const struct Camera *camera, int32_t id, double value) {
    switch (id) {
    case SUBARRAYHPOS: return value + stored(camera, SUBARRAYHSIZE) <= SENSOR_PX;
    case SUBARRAYHSIZE: return value + stored(camera, SUBARRAYHPOS) <= SENSOR_PX;
    case SUBARRAYVPOS: return value + stored(camera, SUBARRAYVSIZE) <= SENSOR_PX;
    case SUBARRAYVSIZE: return value + stored(camera, SUBARRAYVPOS) <= SENSOR_PX;
    default: return true;
    }
}

/* Move values that the new mode does not allow into its range. */
static void follow_mode(struct Camera *camera, int32_t id) {
    if (id == CCDMODE) {
        store(camera, READOUTSPEED, is_em(camera) ? 3 : 1);
        store(camera, CONTRASTGAIN, 1);
        store(camera, HIGHDYNAMICRANGE_MODE, MODE_OFF);
    }
    double exposure_s = fmin(stored(camera, EXPOSURETIME), longest_exposure_s(camera));
    store(camera, EXPOSURETIME, fmax(exposure_s, shortest_exposure_s(camera)));
    if (id == DIRECTEMGAIN_MODE)
        store(camera, SENSITIVITY, stored(camera, DIRECTEMGAIN_MODE) == MODE_ON ? LOWEST_EM_GAIN : 0);
}

int32_t dcamprop_getattr(HDCAM h, DCAMPROP_ATTR *param) {
    int32_t code = enter_camera(F_dcamprop_getattr, h), element;
    if (code < 0) return leave(code);
    if (!param || param->cbSize != sizeof *param) return leave(INVALIDPARAM);
    const Property *property = find(h, param->iProp, &element);
    if (!property) return leave(INVALIDPROPERTYID);
    Limits allowed = limits(h, property);
    uint32_t attribute = (uint32_t)property->type | ATTR_HASDEFAULT | ATTR_EFFECTIVE;
    if (property->choices) attribute |= ATTR_HASVALUETEXT;
    if (property->access & R) attribute |= ATTR_READABLE;
    if (property->access & W) attribute |= ATTR_WRITABLE | (world.rounds ? ATTR_AUTOROUNDING : 0);
    else attribute |= ATTR_VOLATILE;
    if (property->access & WR) attribute |= ATTR_ACCESSREADY;
    if (property->access & WB) attribute |= ATTR_ACCESSBUSY;
    if (allowed.maximum > allowed.minimum) attribute |= ATTR_HASRANGE;
    if (allowed.step > 0) attribute |= ATTR_HASSTEP;
    *param = (DCAMPROP_ATTR){.cbSize = sizeof *param, .iProp = param->iProp, .attribute = (int32_t)attribute};
    param->iUnit = property->unit;
    param->valuemin = allowed.minimum;
    param->valuemax = allowed.maximum;
    param->valuestep = allowed.step;
    param->valuedefault = allowed.initial;
    if (property->elements > 1) {
        param->attribute2 = element ? ATTR2_ARRAYELEMENT : ATTR2_ARRAYBASE;
        param->iProp_NumberOfElement = NUMBEROF_OUTPUTTRIGGERCONNECTOR;
        param->iProp_ArrayBase = property->id;
        param->iPropStep_Element = ELEMENT_STEP;
    }
    return leave(code);
}

int32_t dcamprop_getvalue(HDCAM h, int32_t iProp, double *value) {
    int32_t code = enter_camera(F_dcamprop_getvalue, h), element;
    if (code < 0) {
        if (code == NOCONNECTION && iProp == SYSTEM_ALIVE) { /* the one query that is still answered */
            *value = ALIVE_OFFLINE;
            code = SUCCESS;
        }
        return leave(code);
    }
    const Property *property = find(h, iProp, &element);
    if (!property) return leave(INVALIDPROPERTYID);
    if (!(property->access & R)) return leave(NOTREADABLE);
    bool is_mode = (property->access & WS) && !(property->access & WB);
    bool is_denied = h->is_capturing && !world.answers_while_busy && (is_mode || iProp == SYSTEM_ALIVE);
    if (is_denied) return leave(ACCESSDENY);
    *value = element ? h->values[property - SHEET][element] : value_of(h, iProp);
    return leave(code);
}

int32_t dcamprop_setgetvalue(HDCAM h, int32_t iProp, double *value, int32_t option) {
    (void)option;
    int32_t code = enter_camera(F_dcamprop_setgetvalue, h), element;
    if (code < 0) return leave(code);
    const Property *property = find(h, iProp, &element);
    if (!property) return leave(INVALIDPROPERTYID);
    if (iProp == world.refused_id) return leave(world.refused_code);
    if (!(property->access & W)) return leave(NOTWRITABLE);
    if (h->is_capturing && !(property->access & WB)) return leave(ACCESSDENY);
    if (!h->is_capturing && h->ring && !(property->access & WR)) return leave(ACCESSDENY);
    code = take(h, property, value);
    if (code < 0) return leave(code);
    if (!fits(h, iProp, *value)) return leave(INVALIDSUBARRAY);
    bool has_high_range = is_em(h) && stored(h, READOUTSPEED) < 3;
    if (iProp == HIGHDYNAMICRANGE_MODE && *value == MODE_ON && !has_high_range) return leave(NOTSUPPORT);
    h->values[property - SHEET][element] = *value;
    follow_mode(h, iProp);
    return leave(code);
}

/* Next or previous allowed value. */
int32_t dcamprop_queryvalue(HDCAM h, int32_t iProp, double *value, int32_t option) {
    int32_t code = enter_camera(F_dcamprop_queryvalue, h), element;
    if (code < 0) return leave(code);
    const Property *property = find(h, iProp, &element);
    if (!property) return leave(INVALIDPROPERTYID);
    if (option != OPTION_NEXT && option != OPTION_PRIOR) return leave(INVALIDPARAM);
    Limits allowed = limits(h, property);
    double direction = option == OPTION_NEXT ? 1 : -1;
    if (allowed.step <= 0) return leave(OUTOFRANGE);
    for (double next = *value + direction * allowed.step; next >= allowed.minimum && next <= allowed.maximum;
         next += direction * allowed.step)
        if (!property->choices || choice(property, next)) {
            *value = next;
            return leave(code);
        }
    return leave(OUTOFRANGE);
}

int32_t dcamprop_getnextid(HDCAM h, int32_t *iProp, int32_t option) {
    int32_t code = enter_camera(F_dcamprop_getnextid, h), element;
    if (code < 0) return leave(code);
    if (option == OPTION_ARRAYELEMENT) {
        const Property *property = find(h, *iProp, &element);
        if (!property || element + 1 >= property->elements) return leave(NOPROPERTY);
        *iProp += ELEMENT_STEP;
        return leave(code);
    }
    if (option != 0 && option != OPTION_NEXT) return leave(NOTSUPPORT);
    for (int32_t i = 0; i < SHEET_LENGTH; i++)
        if (SHEET[i].id > *iProp && !is_absent(h, SHEET[i].id)) {
            *iProp = SHEET[i].id;
            return leave(code);
        }
    return leave(NOPROPERTY);
}

int32_t dcamprop_getname(HDCAM h, int32_t iProp, char *text, int32_t textbytes) {
    int32_t code = enter_camera(F_dcamprop_getname, h), element;
    if (code < 0) return leave(code);
    const Property *property = find(h, iProp, &element);
    if (!property) return leave(INVALIDPROPERTYID);
    if (!text || textbytes < 1) return leave(INVALIDPARAM);
    if (element) snprintf(text, (size_t)textbytes, "%s[%d]", property->name, element);
    else snprintf(text, (size_t)textbytes, "%s", property->name);
    return leave(code);
}

int32_t dcamprop_getvaluetext(HDCAM h, DCAMPROP_VALUETEXT *param) {
    int32_t code = enter_camera(F_dcamprop_getvaluetext, h), element;
    if (code < 0) return leave(code);
    if (!param || param->cbSize != sizeof *param || !param->text || param->textbytes < 1) return leave(INVALIDPARAM);
    const Property *property = find(h, param->iProp, &element);
    if (!property) return leave(INVALIDPROPERTYID);
    const Choice *named = choice(property, param->value);
    if (!named) return leave(INVALIDVALUE);
    snprintf(param->text, (size_t)param->textbytes, "%s", named->text);
    return leave(code);
}
