/* Sends native packets of six sensors at rest in different orientations: for trying a line without sensors, and as an example for
 * firmware.
 *
 *     cc -I ../../c send_packets.c -o send_packets
 *     ./send_packets 500 > still.bin         a capture of 5 s, written at once
 *     ./send_packets 0 /dev/ttyS0            100 times a second until stopped; set the line to 230400 bit/s or more before (stty)
 */
#define _POSIX_C_SOURCE 199309L

#include <stdio.h>
#include <stdlib.h>
#include <time.h>

#include "edgepose_packet.h"

#define SENSORS 6
#define RATE_HZ 100
#define INFO_EVERY (2 * RATE_HZ)

/* SMPL joints whose bones carry the sensors: left and right forearm, left and right lower leg, head, pelvis. */
static const uint8_t segments[SENSORS] = {18, 19, 4, 5, 15, 0};

/* Orientation sensor to inertial frame, and the up direction in the sensor frame: the third row of the rotation matrix. */
static const struct {
    float quat[4], up[3];
} poses[SENSORS] = {
    {{1.0f, 0.0f, 0.0f, 0.0f}, {0.0f, 0.0f, 1.0f}},
    {{0.0f, 0.0f, 0.0f, 1.0f}, {0.0f, 0.0f, 1.0f}},
    {{0.70710678f, 0.70710678f, 0.0f, 0.0f}, {0.0f, 1.0f, 0.0f}},
    {{0.70710678f, -0.70710678f, 0.0f, 0.0f}, {0.0f, -1.0f, 0.0f}},
    {{0.70710678f, 0.0f, 0.70710678f, 0.0f}, {-1.0f, 0.0f, 0.0f}},
    {{0.5f, 0.5f, 0.5f, 0.5f}, {0.0f, 1.0f, 0.0f}},
};

static int put(FILE *line, const uint8_t *wire, size_t n) { return n != 0 && fwrite(wire, 1, n, line) == n; }

static int send_info(FILE *line, uint8_t sensor) {
    edgepose_info info = {0};
    uint8_t wire[EDGEPOSE_MAX_WIRE];
    info.sensor_id = sensor;
    info.segment = segments[sensor];
    info.frame = EDGEPOSE_FRAME_Z_UP;
    info.rate_dhz = 10 * RATE_HZ;
    info.firmware = "send_packets 1";
    return put(line, wire, edgepose_encode_info(&info, wire));
}

static int send_sample(FILE *line, uint8_t sensor, unsigned long number) {
    edgepose_packet p = {0};
    uint8_t wire[EDGEPOSE_MAX_WIRE];
    int i;
    p.sensor_id = sensor;
    p.seq = (uint16_t)(number & 0xFFFFu);
    p.t_us = (uint32_t)((uint64_t)number * (1000000u / RATE_HZ) & 0xFFFFFFFFu);
    p.fields = EDGEPOSE_QUAT | EDGEPOSE_ACC | EDGEPOSE_GYR;
    memcpy(p.quat, poses[sensor].quat, sizeof p.quat);
    for (i = 0; i < 3; i++) p.acc[i] = 9.81f * poses[sensor].up[i];
    return put(line, wire, edgepose_encode(&p, wire));
}

/* Waits until a sample is due, counted from the start so that errors do not accumulate. */
static void wait_for(const struct timespec *start, unsigned long number) {
    struct timespec now, rest;
    long long left;
    clock_gettime(CLOCK_MONOTONIC, &now);
    left = (start->tv_sec - now.tv_sec) * 1000000000LL + (start->tv_nsec - now.tv_nsec);
    left += (long long)number * (1000000000 / RATE_HZ);
    if (left <= 0) return;
    rest.tv_sec = (time_t)(left / 1000000000);
    rest.tv_nsec = (long)(left % 1000000000);
    nanosleep(&rest, NULL);
}

int main(int argc, char **argv) {
    const unsigned long samples = argc > 1 ? strtoul(argv[1], NULL, 10) : 0;
    const int live = argc > 2;
    struct timespec start;
    unsigned long number;
    FILE *line = stdout;
    if (argc < 2 || argc > 3 || (!live && samples == 0)) {
        fprintf(stderr, "usage: send_packets SAMPLES [DEVICE]; with a device, 0 samples means until stopped\n");
        return 2;
    }
    if (live && (line = fopen(argv[2], "wb")) == NULL) {
        perror(argv[2]);
        return 1;
    }
    clock_gettime(CLOCK_MONOTONIC, &start);
    for (number = 0; samples == 0 || number < samples; number++) {
        uint8_t sensor;
        int good = 1;
        if (live) wait_for(&start, number);
        for (sensor = 0; sensor < SENSORS; sensor++) {
            if (number % INFO_EVERY == 0) good = good && send_info(line, sensor);
            good = good && send_sample(line, sensor, number);
        }
        if (!good || (live && fflush(line) != 0)) {
            perror("send_packets");
            return 1;
        }
    }
    if (fclose(line) != 0) {
        perror("send_packets");
        return 1;
    }
    return 0;
}
