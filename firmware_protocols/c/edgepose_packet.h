/* Encoder for edgepose's native packets, for firmware: serial lines, CAN 2.0 and CAN FD. C99 or C++, header only, no heap; needs
 * nothing but the standard integer types and memcpy.
 *
 * Layouts are in firmware_protocols/README.md. Numbers are converted with integer arithmetic, so the bytes are the same on every
 * board, whatever its byte order, floating-point unit and compiler flags; `float` must be IEEE 754 binary32.
 *
 *     edgepose_packet p = {0};
 *     uint8_t wire[EDGEPOSE_MAX_WIRE];
 *     p.sensor_id = 3; p.seq = seq++; p.t_us = micros();
 *     p.fields = EDGEPOSE_QUAT | EDGEPOSE_ACC | EDGEPOSE_GYR;
 *     p.quat[0] = 1.0f; ...
 *     size_t n = edgepose_encode(&p, wire);
 *     if (n) Serial.write(wire, n);
 */
#ifndef EDGEPOSE_PACKET_H
#define EDGEPOSE_PACKET_H

#include <stddef.h>
#include <stdint.h>
#include <string.h>

/* Field mask. For each vector choose either the int16 or the _F32 form, not both. */
#define EDGEPOSE_QUAT 0x001u
#define EDGEPOSE_ACC 0x002u
#define EDGEPOSE_GYR 0x004u
#define EDGEPOSE_MAG 0x008u
#define EDGEPOSE_TEMPERATURE 0x010u
#define EDGEPOSE_QUAT_F32 0x020u
#define EDGEPOSE_ACC_F32 0x040u
#define EDGEPOSE_GYR_F32 0x080u
#define EDGEPOSE_MAG_F32 0x100u
#define EDGEPOSE_BATTERY 0x200u

/* Inertial frame of the quaternions, for the INFO packet. */
#define EDGEPOSE_FRAME_UNKNOWN 0u
#define EDGEPOSE_FRAME_ENU 1u
#define EDGEPOSE_FRAME_NWU 2u
#define EDGEPOSE_FRAME_NED 3u
#define EDGEPOSE_FRAME_Z_UP 4u /* Z up, heading arbitrary (no magnetometer) */

#define EDGEPOSE_NO_SEGMENT 255u
#define EDGEPOSE_MAX_FIRMWARE 32u
#define EDGEPOSE_MAX_BODY 66u
#define EDGEPOSE_MAX_WIRE (EDGEPOSE_MAX_BODY + 4u) /* body, CRC, one byte of COBS, closing 00 */

typedef struct {
    uint8_t sensor_id;
    uint16_t seq;  /* increases by one with each packet of this sensor, wraps */
    uint32_t t_us; /* time of the measurement, microseconds, wraps */
    uint16_t fields;
    float quat[4]; /* w, x, y, z, unit length, sensor to inertial frame */
    float acc[3];  /* specific force, sensor frame, m/s^2: +9.81 on the axis that points up at rest */
    float gyr[3];  /* sensor frame, rad/s */
    float mag[3];  /* sensor frame, uT */
    float temperature;       /* degC */
    uint8_t battery_percent; /* above 100 is sent as 100 */
    uint8_t battery_status;  /* bits for your own use */
} edgepose_packet;

typedef struct {
    uint8_t sensor_id;
    uint8_t segment;      /* SMPL joint 0..23 whose bone carries the sensor, or EDGEPOSE_NO_SEGMENT */
    uint8_t frame;        /* EDGEPOSE_FRAME_... */
    uint16_t rate_dhz;    /* packets per second times 10 (100 Hz is 1000), 0 if unknown */
    const char *firmware; /* printable ASCII, at most EDGEPOSE_MAX_FIRMWARE characters */
} edgepose_info;

/* --- bytes ------------------------------------------------------------------------------------------------------------- */

static inline uint8_t *edgepose_put16(uint8_t *out, uint16_t value) {
    out[0] = (uint8_t)(value & 0xFFu);
    out[1] = (uint8_t)(value >> 8);
    return out + 2;
}

static inline uint8_t *edgepose_put32(uint8_t *out, uint32_t value) {
    out = edgepose_put16(out, (uint16_t)(value & 0xFFFFu));
    return edgepose_put16(out, (uint16_t)(value >> 16));
}

/* Returns a value times scale (at most 32767) as int16 in two's complement: rounded to the nearest, halves away from zero,
 * clamped. `bits` is a finite binary32. */
static inline uint16_t edgepose_fixed(uint32_t bits, uint16_t scale) {
    const int negative = (bits >> 31) != 0;
    const int exponent = (int)((bits >> 23) & 0xFFu); /* value = mantissa * 2^(exponent - 150) */
    const uint32_t limit = negative ? 32768u : 32767u;
    uint32_t size;
    if (exponent >= 127 + 16) { /* 65536 or more: out of range at every scale */
        size = limit;
    } else if (exponent < 127 - 17) { /* less than half a step at every scale */
        size = 0;
    } else {
        const uint64_t product = (uint64_t)((bits & 0x7FFFFFu) | 0x800000u) * scale;
        const int shift = 150 - exponent; /* 8..40 */
        const uint64_t rounded = (product + ((uint64_t)1 << (shift - 1))) >> shift;
        size = rounded < limit ? (uint32_t)rounded : limit;
    }
    return (uint16_t)((negative ? 0x10000u - size : size) & 0xFFFFu);
}

/* Writes n floats, as binary32 if scale is 0, else as int16; returns the end of the output, or NULL if one is NaN or infinite. */
static inline uint8_t *edgepose_put_floats(uint8_t *out, const float *values, size_t n, uint16_t scale) {
    size_t i;
    for (i = 0; i < n; i++) {
        uint32_t bits;
        memcpy(&bits, &values[i], sizeof bits);
        /* isfinite() is not used: -ffast-math removes it. */
        if (((bits >> 23) & 0xFFu) == 0xFFu) return NULL;
        out = scale ? edgepose_put16(out, edgepose_fixed(bits, scale)) : edgepose_put32(out, bits);
    }
    return out;
}

/* --- packets ----------------------------------------------------------------------------------------------------------- */

/* Returns the CRC-16 with polynomial 0x1021 and initial value 0xFFFF; that of "123456789" is 0x29B1. */
static inline uint16_t edgepose_crc16(const uint8_t *data, size_t n) {
    uint16_t crc = 0xFFFFu;
    size_t i;
    for (i = 0; i < n; i++) {
        uint16_t x = (uint16_t)((crc >> 8) ^ data[i]);
        x = (uint16_t)(x ^ (x >> 4));
        crc = (uint16_t)(((uint32_t)crc << 8) ^ ((uint32_t)x << 12) ^ ((uint32_t)x << 5) ^ x);
    }
    return crc;
}

/* Writes the COBS encoding of data, without the closing 00: at most n + n / 254 + 1 bytes. Returns their number. */
static inline size_t edgepose_cobs(const uint8_t *data, size_t n, uint8_t *out) {
    size_t code_at = 0, end = 1, i;
    uint8_t code = 1;
    for (i = 0; i < n; i++) {
        if (data[i]) {
            out[end++] = data[i];
            code++;
        }
        if (!data[i] || (code == 255 && i + 1 < n)) {
            out[code_at] = code;
            code_at = end++;
            code = 1;
        }
    }
    out[code_at] = code;
    return end;
}

/* Writes the body of a measurement, without CRC and framing, as CAN FD carries it. `out` holds EDGEPOSE_MAX_BODY bytes.
 * Returns its length, or 0 if the mask is illegal or a number is NaN or infinite. */
static inline size_t edgepose_encode_body(const edgepose_packet *p, uint8_t *out) {
    uint8_t *end = out;
    if ((p->fields & ~0x3FFu) || (p->fields & (p->fields >> 5) & 0xFu)) return 0;
    *end++ = 0x11;
    *end++ = p->sensor_id;
    end = edgepose_put16(end, p->fields);
    end = edgepose_put16(end, p->seq);
    end = edgepose_put32(end, p->t_us);
    if (p->fields & EDGEPOSE_QUAT) end = edgepose_put_floats(end, p->quat, 4, 32767);
    if (end && (p->fields & EDGEPOSE_ACC)) end = edgepose_put_floats(end, p->acc, 3, 100);
    if (end && (p->fields & EDGEPOSE_GYR)) end = edgepose_put_floats(end, p->gyr, 3, 900);
    if (end && (p->fields & EDGEPOSE_MAG)) end = edgepose_put_floats(end, p->mag, 3, 10);
    if (end && (p->fields & EDGEPOSE_TEMPERATURE)) end = edgepose_put_floats(end, &p->temperature, 1, 100);
    if (end && (p->fields & EDGEPOSE_QUAT_F32)) end = edgepose_put_floats(end, p->quat, 4, 0);
    if (end && (p->fields & EDGEPOSE_ACC_F32)) end = edgepose_put_floats(end, p->acc, 3, 0);
    if (end && (p->fields & EDGEPOSE_GYR_F32)) end = edgepose_put_floats(end, p->gyr, 3, 0);
    if (end && (p->fields & EDGEPOSE_MAG_F32)) end = edgepose_put_floats(end, p->mag, 3, 0);
    if (!end) return 0;
    if (p->fields & EDGEPOSE_BATTERY) {
        *end++ = p->battery_percent < 100 ? p->battery_percent : 100;
        *end++ = p->battery_status;
    }
    return (size_t)(end - out);
}

/* Writes the body of an INFO packet. Returns its length, or 0 if a member is out of range. */
static inline size_t edgepose_encode_info_body(const edgepose_info *info, uint8_t *out) {
    size_t n = 0;
    for (; info->firmware[n]; n++) {
        if (n == EDGEPOSE_MAX_FIRMWARE || info->firmware[n] < 0x20 || info->firmware[n] > 0x7E) return 0;
    }
    if ((info->segment > 23 && info->segment != EDGEPOSE_NO_SEGMENT) || info->frame > EDGEPOSE_FRAME_Z_UP) return 0;
    out[0] = 0x12;
    out[1] = info->sensor_id;
    out[2] = info->segment;
    out[3] = info->frame;
    edgepose_put16(out + 4, info->rate_dhz);
    out[6] = (uint8_t)n;
    memcpy(out + 7, info->firmware, n);
    return n + 7;
}

/* Writes the bytes on the wire for a body: CRC, COBS, closing 00. `wire` holds EDGEPOSE_MAX_WIRE bytes. Returns their number, or
 * 0 if the body is empty or too long. */
static inline size_t edgepose_frame_body(const uint8_t *body, size_t n, uint8_t *wire) {
    uint8_t data[EDGEPOSE_MAX_BODY + 2];
    size_t end;
    if (n == 0 || n > EDGEPOSE_MAX_BODY) return 0;
    memcpy(data, body, n);
    edgepose_put16(data + n, edgepose_crc16(body, n));
    end = edgepose_cobs(data, n + 2, wire);
    wire[end] = 0;
    return end + 1;
}

/* Writes the bytes on the wire for a measurement. `wire` holds EDGEPOSE_MAX_WIRE bytes. Returns their number, or 0 as above. */
static inline size_t edgepose_encode(const edgepose_packet *p, uint8_t *wire) {
    uint8_t body[EDGEPOSE_MAX_BODY];
    return edgepose_frame_body(body, edgepose_encode_body(p, body), wire);
}

/* Writes the bytes on the wire for an INFO packet. Send one at the start and then every few seconds. */
static inline size_t edgepose_encode_info(const edgepose_info *info, uint8_t *wire) {
    uint8_t body[EDGEPOSE_MAX_BODY];
    return edgepose_frame_body(body, edgepose_encode_info_body(info, body), wire);
}

/* --- CAN --------------------------------------------------------------------------------------------------------------- */

#define EDGEPOSE_CAN_BASE 0x400u  /* default: identifiers 0x400..0x47F, 11 bits; above 0x780 all identifiers have 29 bits */
#define EDGEPOSE_CAN_SYNC 0x080u  /* 11 bits */
#define EDGEPOSE_CAN_MAX_FRAMES 4u
#define EDGEPOSE_CANFD_MAX 64u

typedef struct {
    uint32_t id;
    uint8_t length;
    uint8_t data[8];
} edgepose_can_frame;

/* Returns the identifier of a message of sensor 0..31. Messages: 0 ACC or a CAN FD packet, 1 QUAT, 2 GYR, 3 MAG. */
static inline uint32_t edgepose_can_id(uint32_t base, uint8_t message, uint8_t sensor_id) {
    return base + (((uint32_t)message << 5) | sensor_id);
}

/* State for deriving the 100 us time of CAN 2.0 frames from a microsecond clock, without a jump where that clock wraps. Keep one
 * per sensor, initialised with zeros, and call edgepose_can_ticks with each t_us, at least once in 71 minutes. */
typedef struct {
    uint32_t last_us;
    uint32_t rest_us;
    uint16_t ticks;
} edgepose_can_clock;

static inline uint16_t edgepose_can_ticks(edgepose_can_clock *clock, uint32_t t_us) {
    const uint32_t passed = t_us - clock->last_us + clock->rest_us;
    clock->last_us = t_us;
    clock->rest_us = passed % 100u;
    clock->ticks = (uint16_t)((clock->ticks + passed / 100u) & 0xFFFFu);
    return clock->ticks;
}

/* Writes the CAN 2.0 frames of a measurement: ACC, then GYR and MAG if present, then QUAT, which is empty without a quaternion.
 * Send them in this order (no mailboxes that go by identifier), all of one sample before the next of the same sensor. Vectors
 * are sent as int16 whichever form the mask has; sequence number, temperature and battery are left out. `frames` holds
 * EDGEPOSE_CAN_MAX_FRAMES. Returns their number, or 0 if the sensor id is above 31, there is no acceleration, or a number is NaN
 * or infinite. */
static inline size_t edgepose_can_encode(const edgepose_packet *p, uint32_t base, uint16_t ticks, edgepose_can_frame *frames) {
    static const uint8_t messages[3] = {0, 2, 3};
    static const uint16_t scales[3] = {100, 900, 10};
    const float *vectors[3];
    const unsigned fields = (unsigned)p->fields | ((unsigned)p->fields >> 5);
    size_t n = 0, i;
    vectors[0] = p->acc;
    vectors[1] = p->gyr;
    vectors[2] = p->mag;
    if (p->sensor_id > 31 || !(fields & EDGEPOSE_ACC)) return 0;
    for (i = 0; i < 3; i++) {
        uint8_t *end = frames[n].data;
        if (!(fields & (EDGEPOSE_ACC << i))) continue;
        end = edgepose_put_floats(end, vectors[i], 3, scales[i]);
        if (!end) return 0;
        edgepose_put16(end, ticks);
        frames[n].id = edgepose_can_id(base, messages[i], p->sensor_id);
        frames[n++].length = 8;
    }
    frames[n].id = edgepose_can_id(base, 1, p->sensor_id);
    frames[n].length = 0;
    if (fields & EDGEPOSE_QUAT) {
        if (!edgepose_put_floats(frames[n].data, p->quat, 4, 32767)) return 0;
        frames[n].length = 8;
    }
    return n + 1;
}

/* Writes a SYNC frame: the sender's time, by which other nodes set their clocks. */
static inline void edgepose_can_sync(uint32_t t_us, edgepose_can_frame *frame) {
    frame->id = EDGEPOSE_CAN_SYNC;
    frame->length = 4;
    edgepose_put32(frame->data, t_us);
}

/* Turns a body of edgepose_encode_body or edgepose_encode_info_body into the data of a CAN FD frame (message 0): pads it with
 * zeros to a legal length. `body` holds EDGEPOSE_MAX_BODY bytes. Returns the length, or 0 if n is 0 or above 64. */
static inline size_t edgepose_canfd_pad(uint8_t *body, size_t n) {
    static const uint8_t lengths[8] = {8, 12, 16, 20, 24, 32, 48, 64};
    size_t i;
    if (n == 0 || n > EDGEPOSE_CANFD_MAX) return 0;
    for (i = 0; lengths[i] < n; i++) {}
    memset(body + n, 0, lengths[i] - n);
    return lengths[i];
}

#endif
