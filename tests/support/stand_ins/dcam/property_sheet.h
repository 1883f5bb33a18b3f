/* The properties of a C9100-23B: facts of Hamamatsu's sheet for this camera, v21.6.6291. */
#ifndef SVWFS_PROPERTY_SHEET_H
#define SVWFS_PROPERTY_SHEET_H

#include <stdint.h>

/* Can be read; written while stable, ready, busy. */
#define R 1
#define WS 2
#define WR 4
#define WB 8
#define W (WS | WR | WB)

enum { NO_UNIT = 0, SECOND = 1, CELSIUS = 2, PER_SECOND = 5, MICROMETER = 7 };

typedef struct {
    int32_t value;
    const char *text; /* NULL ends the list */
} Choice;

typedef struct {
    int32_t id;
    const char *name;
    int32_t type, unit, access;
    double minimum, maximum, step, initial;
    const Choice *choices; /* of a mode */
    int32_t elements;      /* of an array */
} Property;

extern const Property SHEET[];
extern const int32_t SHEET_LENGTH;

#endif
