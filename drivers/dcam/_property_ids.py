"""DCAM properties and values that the driver uses, by number."""

from enum import IntEnum, IntFlag


class Id(IntEnum):
    """Property numbers."""

    TRIGGERSOURCE = 0x00100110
    TRIGGERACTIVE = 0x00100120
    TRIGGER_MODE = 0x00100210
    TRIGGERPOLARITY = 0x00100220
    TRIGGERTIMES = 0x00100240
    TRIGGERDELAY = 0x00100260
    OUTPUTTRIGGER_KIND = 0x001C0160  # of the first connector
    OUTPUTTRIGGER_POLARITY = 0x001C0120
    EXPOSURETIME = 0x001F0110
    TRIGGER_GLOBALEXPOSURE = 0x001F0300
    SENSITIVITY = 0x00200220
    DIRECTEMGAIN_MODE = 0x00200250
    EMGAINWARNING_STATUS = 0x00200260
    EMGAINWARNING_LEVEL = 0x00200270
    EMGAINPROTECT_MODE = 0x00200290
    EMGAINPROTECT_AFTERFRAMES = 0x002002A0
    PHOTONIMAGINGMODE = 0x002002F0
    SENSORTEMPERATURE = 0x00200310
    SENSORCOOLER = 0x00200320
    SENSORCOOLERSTATUS = 0x00200340
    HIGHDYNAMICRANGE_MODE = 0x00300150
    REALTIMEGAINCORRECT_MODE = 0x00300170
    RECURSIVEFILTER = 0x00380110
    SPOTNOISEREDUCER = 0x00380130
    SUBTRACT = 0x00380210
    SHADINGCORRECTION = 0x00380310
    FRAMEAVERAGINGMODE = 0x003803A0
    CAPTUREMODE = 0x00380410
    INTENSITYLUT_MODE = 0x00380510
    INTENSITY_GAMMA = 0x00380560
    ADVANCEDEDGEENHANCEMENT_MODE = 0x00380630
    READOUTSPEED = 0x00400110
    SENSORMODE = 0x00400210
    CCDMODE = 0x00400310
    EMCCD_CALIBRATIONMODE = 0x00400320
    OUTPUT_INTENSITY = 0x00400410
    OUTPUTDATA_ORIENTATION = 0x00400420
    BINNING = 0x00401110
    SUBARRAYHPOS = 0x00402110
    SUBARRAYHSIZE = 0x00402120
    SUBARRAYVPOS = 0x00402130
    SUBARRAYVSIZE = 0x00402140
    SUBARRAYMODE = 0x00402150
    FRAMESTAMP_PRODUCER = 0x00410A20
    BITSPERCHANNEL = 0x00420130
    IMAGE_WIDTH = 0x00420210
    IMAGE_HEIGHT = 0x00420220
    IMAGE_PIXELTYPE = 0x00420270
    IMAGEDETECTOR_PIXELWIDTH = 0x00420810
    DEFECTCORRECT_MODE = 0x00470010
    SYSTEM_ALIVE = 0x00FF0010


SUBARRAY_POSITION = (Id.SUBARRAYVPOS, Id.SUBARRAYHPOS)  # rows before columns
SUBARRAY_SIZE = (Id.SUBARRAYVSIZE, Id.SUBARRAYHSIZE)
OFF, ON = 1, 2  # of every mode that is one or the other
CCDMODE_NORMAL, CCDMODE_EM = 1, 2
EMGAINWARNING_WARNING, EMGAINWARNING_PROTECTED = 2, 3
PIXELTYPE_MONO16 = 2
GLOBALEXPOSURE_DELAYED = 3  # rolling shutter; larger numbers expose rows unequally, or only while all are open
PRODUCER_NONE = 1
ALIVE_ONLINE = 2
COOLERSTATUS_WARNING = 5  # errors are negative
AMPLIFIERS = {CCDMODE_NORMAL: "normal", CCDMODE_EM: "em"}
TRIGGER_SOURCES = {"internal": 1, "external": 2, "software": 3}
TRIGGERS = {number: name for name, number in TRIGGER_SOURCES.items()}
TRIGGER_ACTIVE = {"edge": 1, "level": 2, "synchronous": 3}
POLARITIES = {"negative": 1, "positive": 2}
COOLER = {"off": 1, "on": 2, "max": 4}
OUTPUTS = {"low": 1, "exposure": 2, "programmable": 3, "trigger ready": 4, "high": 5}

# Harmless value, and the effect of any other.
FILTERS = {
    Id.RECURSIVEFILTER: (OFF, "the camera's recursive filter averages frames, which lowers their noise"),
    Id.FRAMEAVERAGINGMODE: (OFF, "the camera averages frames, which lowers their noise"),
    Id.SPOTNOISEREDUCER: (OFF, "the camera's spot noise reducer changes single pixels"),
    Id.SUBTRACT: (OFF, "the camera subtracts a stored image: the counts are no longer those of the sensor"),
    Id.SHADINGCORRECTION: (OFF, "the camera's shading correction scales the pixels"),
    Id.INTENSITYLUT_MODE: (1, "the camera maps the counts by a table"),
    Id.PHOTONIMAGINGMODE: (0, "the camera's photon imaging mode changes the counts"),
    Id.CAPTUREMODE: (1, "the camera takes calibration frames, no images"),
    Id.EMCCD_CALIBRATIONMODE: (OFF, "the camera calibrates its EM gain: its frames are no images"),
    Id.SENSORMODE: (1, "the camera's sensor mode is not AREA: it may count photons, or expose line by line"),
    Id.OUTPUTDATA_ORIENTATION: (1, "the camera mirrors or flips the image: signs of wavefronts are wrong"),
    Id.OUTPUT_INTENSITY: (1, "the camera sends a test pattern"),
    Id.HIGHDYNAMICRANGE_MODE: (OFF, "the camera's high dynamic range mode changes the counts"),
    Id.REALTIMEGAINCORRECT_MODE: (OFF, "the camera's real-time gain correction scales the pixels"),
    Id.DEFECTCORRECT_MODE: (OFF, "the camera's defect correction replaces single pixels"),
    Id.INTENSITY_GAMMA: (1, "the camera's gamma bends the counts"),
    Id.ADVANCEDEDGEENHANCEMENT_MODE: (OFF, "the camera sharpens the image"),
}


class Attribute(IntFlag):
    """Attributes of a property."""

    HASSTEP = 0x40000000
    HASVALUETEXT = 0x10000000
    AUTOROUNDING = 0x00800000
    READABLE = 0x00010000


TYPE_MASK, TYPE_REAL = 0xF, 3
OPTION_NEXT = 0x01000000
