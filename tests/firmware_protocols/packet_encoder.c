/* Encodes what test_native_c.py sends, one request a line, and answers each with a line of hex (empty for a refusal).
 *   P sensor seq t fields q q q q a a a g g g m m m temperature percent status     a measurement, floats as hex of their bits
 *   I sensor segment frame rate hex-of-firmware-or--                                      an INFO packet
 *   C hex                                                                                  CRC, then COBS, of any bytes
 *   2 base ticks, then as P                                                                CAN 2.0 frames, "id:data" each
 *   F as P, J as I                                                                         data of a CAN FD frame
 *   S t                                                                                    SYNC frame
 *   T t                                                                                    ticks of one running clock
 */
#include <stdio.h>
#include <stdlib.h>

#include "edgepose_packet.h"

static uint8_t bytes[4096], wire[4200];
static char word[8400];

static const char *next(void) {
    if (scanf("%8399s", word) != 1) exit(2);
    return word;
}

static unsigned long whole(void) { return strtoul(next(), NULL, 10); }

static void reals(float *out, int n) {
    int i;
    for (i = 0; i < n; i++) {
        const uint32_t bits = (uint32_t)strtoul(next(), NULL, 16);
        memcpy(&out[i], &bits, sizeof bits);
    }
}

static size_t hex(void) {
    size_t n = 0;
    const char *text = next();
    unsigned value;
    if (text[0] == '-') return 0;
    for (; sscanf(text + 2 * n, "%2x", &value) == 1; n++) bytes[n] = (uint8_t)value;
    return n;
}

static void show(const uint8_t *data, size_t n) {
    size_t i;
    for (i = 0; i < n; i++) printf("%02x", data[i]);
    printf("\n");
}

static edgepose_packet measurement(void) {
    edgepose_packet p;
    p.sensor_id = (uint8_t)whole();
    p.seq = (uint16_t)whole();
    p.t_us = (uint32_t)whole();
    p.fields = (uint16_t)whole();
    reals(p.quat, 4);
    reals(p.acc, 3);
    reals(p.gyr, 3);
    reals(p.mag, 3);
    reals(&p.temperature, 1);
    p.battery_percent = (uint8_t)whole();
    p.battery_status = (uint8_t)whole();
    return p;
}

static edgepose_info info(void) {
    edgepose_info i;
    i.sensor_id = (uint8_t)whole();
    i.segment = (uint8_t)whole();
    i.frame = (uint8_t)whole();
    i.rate_dhz = (uint16_t)whole();
    bytes[hex()] = 0;
    i.firmware = (const char *)bytes;
    return i;
}

static void show_frame(const edgepose_can_frame *frame) {
    size_t i;
    printf("%x:", (unsigned)frame->id);
    for (i = 0; i < frame->length; i++) printf("%02x", frame->data[i]);
    printf(" ");
}

int main(void) {
    edgepose_can_clock clock = {0, 0, 0};
    char request;
    while (scanf(" %c", &request) == 1) {
        /* The sizes the header promises, so that the sanitizers see any byte too many. */
        uint8_t own[EDGEPOSE_MAX_WIRE], body[EDGEPOSE_MAX_BODY];
        edgepose_can_frame frames[EDGEPOSE_CAN_MAX_FRAMES];
        if (request == 'P') {
            const edgepose_packet p = measurement();
            show(own, edgepose_encode(&p, own));
        } else if (request == 'F') {
            const edgepose_packet p = measurement();
            show(body, edgepose_canfd_pad(body, edgepose_encode_body(&p, body)));
        } else if (request == 'I') {
            const edgepose_info i = info();
            show(own, edgepose_encode_info(&i, own));
        } else if (request == 'J') {
            const edgepose_info i = info();
            show(body, edgepose_canfd_pad(body, edgepose_encode_info_body(&i, body)));
        } else if (request == '2') {
            const uint32_t base = (uint32_t)whole();
            const uint16_t ticks = (uint16_t)whole();
            const edgepose_packet p = measurement();
            const size_t n = edgepose_can_encode(&p, base, ticks, frames);
            size_t i;
            for (i = 0; i < n; i++) show_frame(&frames[i]);
            printf("\n");
        } else if (request == 'S') {
            edgepose_can_sync((uint32_t)whole(), frames);
            show_frame(frames);
            printf("\n");
        } else if (request == 'T') {
            printf("%u\n", edgepose_can_ticks(&clock, (uint32_t)whole()));
        } else {
            const size_t n = hex();
            printf("%04x", edgepose_crc16(bytes, n));
            show(wire, edgepose_cobs(bytes, n, wire));
        }
    }
    return 0;
}
