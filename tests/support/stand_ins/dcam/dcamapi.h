/* The part of the DCAM-API 4 that a camera driver needs: names, numbers and layouts are facts of the interface. */
#ifndef SVWFS_DCAMAPI_H
#define SVWFS_DCAMAPI_H

#include <stdint.h>

#if defined(_WIN32)
#define DCAM_EXPORT __declspec(dllexport)
#else
#define DCAM_EXPORT __attribute__((visibility("default")))
#endif

typedef struct Camera *HDCAM;
typedef struct Wait *HDCAMWAIT;

typedef struct {
    int32_t size, iDeviceCount, reserved, initoptionbytes;
    const int32_t *initoption;
    const void *guid;
} DCAMAPI_INIT;

typedef struct {
    int32_t size, index;
    HDCAM hdcam;
} DCAMDEV_OPEN;

typedef struct {
    int32_t size, iString;
    char *text;
    int32_t textbytes;
} DCAMDEV_STRING;

typedef struct {
    int32_t cbSize, iProp, option, iReserved1;
    int32_t attribute, iGroup, iUnit, attribute2;
    double valuemin, valuemax, valuestep, valuedefault;
    int32_t nMaxChannel, iReserved3, nMaxView, iProp_NumberOfElement, iProp_ArrayBase, iPropStep_Element;
} DCAMPROP_ATTR;

typedef struct {
    int32_t cbSize, iProp;
    double value;
    char *text;
    int32_t textbytes;
} DCAMPROP_VALUETEXT;

typedef struct {
    uint32_t sec;
    int32_t microsec;
} DCAM_TIMESTAMP;

typedef struct {
    int32_t size, iKind, nNewestFrameIndex, nFrameCount;
} DCAMCAP_TRANSFERINFO;

typedef struct {
    int32_t size, iKind, option, iFrame;
    void *buf;
    int32_t rowbytes, type, width, height, left, top;
    DCAM_TIMESTAMP timestamp;
    int32_t framestamp, camerastamp;
} DCAMBUF_FRAME;

typedef struct {
    int32_t size, supportevent;
    HDCAMWAIT hwait;
    HDCAM hdcam;
} DCAMWAIT_OPEN;

typedef struct {
    int32_t size, eventhappened, eventmask, timeout;
} DCAMWAIT_START;

/* What the functions return: positive is success, an error has bit 31 set. */
#define SUCCESS 1
#define BUSY ((int32_t)0x80000101)
#define ABORT ((int32_t)0x80000102)
#define NOTREADY ((int32_t)0x80000103)
#define NOTSTABLE ((int32_t)0x80000104)
#define TIMEOUT ((int32_t)0x80000106)
#define NOTBUSY ((int32_t)0x80000107)
#define NOCAMERA ((int32_t)0x80000206)
#define LOSTFRAME ((int32_t)0x80000301)
#define INVALIDCAMERA ((int32_t)0x80000806)
#define INVALIDHANDLE ((int32_t)0x80000807)
#define INVALIDPARAM ((int32_t)0x80000808)
#define INVALIDVALUE ((int32_t)0x80000821)
#define OUTOFRANGE ((int32_t)0x80000822)
#define NOTWRITABLE ((int32_t)0x80000823)
#define NOTREADABLE ((int32_t)0x80000824)
#define INVALIDPROPERTYID ((int32_t)0x80000825)
#define NOPROPERTY ((int32_t)0x80000828)
#define INVALIDSUBARRAY ((int32_t)0x8000082b)
#define ACCESSDENY ((int32_t)0x8000082c)
#define INVALIDFRAMEINDEX ((int32_t)0x80000833)
#define NOTSUPPORT ((int32_t)0x80000f03)
#define UNLOADED ((int32_t)0x80000f04)
#define NOCONNECTION ((int32_t)0x80000f07)
#define FAILOPENCAMERA ((int32_t)0x82001001)
#define FAILREADCAMERA ((int32_t)0x83001002)
#define FAILWRITECAMERA ((int32_t)0x83001003)
#define INVALIDWAITHANDLE ((int32_t)0x84002001)

enum { STATUS_BUSY = 1, STATUS_READY = 2, STATUS_STABLE = 3 };
enum { CAPTURE_SNAP = 0, CAPTURE_SEQUENCE = -1 };
enum { EVENT_FRAMEREADY = 0x2, EVENT_STOPPED = 0x10 };
enum { PIXELTYPE_MONO16 = 2 };
enum {
    IDSTR_BUS = 0x04000101,
    IDSTR_CAMERAID,
    IDSTR_VENDOR,
    IDSTR_MODEL,
    IDSTR_CAMERAVERSION,
    IDSTR_DRIVERVERSION,
    IDSTR_MODULEVERSION,
    IDSTR_DCAMAPIVERSION
};

/* DCAMPROP_ATTR.attribute: type of value and access. */
#define TYPE_MODE 1u
#define TYPE_LONG 2u
#define TYPE_REAL 3u
#define ATTR_HASRANGE 0x80000000u
#define ATTR_HASSTEP 0x40000000u
#define ATTR_HASDEFAULT 0x20000000u
#define ATTR_HASVALUETEXT 0x10000000u
#define ATTR_AUTOROUNDING 0x00800000u
#define ATTR_VOLATILE 0x00080000u
#define ATTR_WRITABLE 0x00020000u
#define ATTR_READABLE 0x00010000u
#define ATTR_ACCESSREADY 0x00002000u
#define ATTR_ACCESSBUSY 0x00001000u
#define ATTR_EFFECTIVE 0x00000200u
#define ATTR2_ARRAYBASE 0x08000000
#define ATTR2_ARRAYELEMENT 0x04000000

#define OPTION_NEXT 0x01000000
#define OPTION_PRIOR ((int32_t)0xFF000000)
#define OPTION_ARRAYELEMENT 0x4

DCAM_EXPORT int32_t dcamapi_init(DCAMAPI_INIT *param);
DCAM_EXPORT int32_t dcamapi_uninit(void);
DCAM_EXPORT int32_t dcamdev_open(DCAMDEV_OPEN *param);
DCAM_EXPORT int32_t dcamdev_close(HDCAM h);
DCAM_EXPORT int32_t dcamdev_getstring(HDCAM h, DCAMDEV_STRING *param);
DCAM_EXPORT int32_t dcamprop_getattr(HDCAM h, DCAMPROP_ATTR *param);
DCAM_EXPORT int32_t dcamprop_getvalue(HDCAM h, int32_t iProp, double *value);
DCAM_EXPORT int32_t dcamprop_setgetvalue(HDCAM h, int32_t iProp, double *value, int32_t option);
DCAM_EXPORT int32_t dcamprop_queryvalue(HDCAM h, int32_t iProp, double *value, int32_t option);
DCAM_EXPORT int32_t dcamprop_getnextid(HDCAM h, int32_t *iProp, int32_t option);
DCAM_EXPORT int32_t dcamprop_getname(HDCAM h, int32_t iProp, char *text, int32_t textbytes);
DCAM_EXPORT int32_t dcamprop_getvaluetext(HDCAM h, DCAMPROP_VALUETEXT *param);
DCAM_EXPORT int32_t dcambuf_alloc(HDCAM h, int32_t framecount);
DCAM_EXPORT int32_t dcambuf_release(HDCAM h, int32_t iKind);
DCAM_EXPORT int32_t dcambuf_copyframe(HDCAM h, DCAMBUF_FRAME *frame);
DCAM_EXPORT int32_t dcamcap_start(HDCAM h, int32_t mode);
DCAM_EXPORT int32_t dcamcap_stop(HDCAM h);
DCAM_EXPORT int32_t dcamcap_status(HDCAM h, int32_t *status);
DCAM_EXPORT int32_t dcamcap_transferinfo(HDCAM h, DCAMCAP_TRANSFERINFO *param);
DCAM_EXPORT int32_t dcamwait_open(DCAMWAIT_OPEN *param);
DCAM_EXPORT int32_t dcamwait_close(HDCAMWAIT hwait);
DCAM_EXPORT int32_t dcamwait_start(HDCAMWAIT hwait, DCAMWAIT_START *param);
DCAM_EXPORT int32_t dcamwait_abort(HDCAMWAIT hwait);

#endif
