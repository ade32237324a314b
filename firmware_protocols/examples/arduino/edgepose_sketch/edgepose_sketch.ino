/* Sends edgepose's native packets from an Arduino board.
 *
 *   1. Copy edgepose_packet.h (firmware_protocols/c) into the folder of this sketch.
 *   2. Choose SENSOR and LINK below; for a sensor of your own, fill in the two functions of SENSOR_OWN.
 *   3. edgepose needs six sensors, ids 0 to 5: left forearm, right forearm, left lower leg, right lower leg, head, pelvis.
 *      All on one board: SENSOR_COUNT 6 and a serial link. One per board: FIRST_ID 0 to 5 and a CAN bus or Wi-Fi.
 *
 * The project's tests compile and run this with stand-ins for the libraries. It has not been run on a board.
 */
#include <Arduino.h>

#include "edgepose_packet.h"

#define SENSOR_OWN 0    /* your own code; as delivered, made-up data of a level sensor at rest */
#define SENSOR_BNO085 1 /* Adafruit_BNO08x on I2C; that library supports one sensor per board */
#define LINK_SERIAL 0   /* USB or UART */
#define LINK_ESP32_CAN 1 /* CAN 2.0, 1 Mbit/s, with the ESP32's own controller and a transceiver */
#define LINK_ESP32_WIFI 2 /* UDP datagrams over Wi-Fi: edgepose run --listen 0.0.0.0:9000 */

#ifndef SENSOR
#define SENSOR SENSOR_OWN
#endif
#ifndef LINK
#define LINK LINK_SERIAL
#endif
#ifndef FIRST_ID
#define FIRST_ID 0
#endif
#ifndef SENSOR_COUNT
#define SENSOR_COUNT 1
#endif

static const unsigned long BAUD = 921600;
static const uint32_t PERIOD_US = 10000; /* 100 Hz */
static const uint32_t INFO_PERIOD_MS = 2000;
/* SMPL joint whose bone carries the sensor, by id. */
static const uint8_t SEGMENTS[6] = {18, 19, 4, 5, 15, 0};

/* --- the sensor: beginSensor() starts sensor i; readSensor() fills in a measurement and returns true if there is a new one ---- */

#if SENSOR == SENSOR_BNO085

#include <Adafruit_BNO08x.h>

static const char FIRMWARE[] = "edgepose_sketch 1 BNO085";
static const uint8_t FRAME = EDGEPOSE_FRAME_Z_UP; /* the game rotation vector uses no magnetometer */
static Adafruit_BNO08x bno(-1);
static float acc[3], gyr[3];
static uint32_t accTime, gyrTime;

static void enableReports() {
    accTime = gyrTime = micros() - 2 * PERIOD_US; /* none yet */
    bno.enableReport(SH2_ACCELEROMETER, PERIOD_US);
    bno.enableReport(SH2_GYROSCOPE_CALIBRATED, PERIOD_US);
    bno.enableReport(SH2_GAME_ROTATION_VECTOR, PERIOD_US);
}

static bool beginSensor(uint8_t) {
    if (!bno.begin_I2C()) return false;
    enableReports();
    return true;
}

/* The three reports arrive one by one; an orientation is sent with the latest two others, unless they are too old. */
static bool readSensor(uint8_t, edgepose_packet *p) {
    sh2_SensorValue_t value;
    const uint32_t now = micros();
    if (bno.wasReset()) enableReports();
    if (!bno.getSensorEvent(&value)) return false;
    if (value.sensorId == SH2_ACCELEROMETER) {
        accTime = now;
        acc[0] = value.un.accelerometer.x;
        acc[1] = value.un.accelerometer.y;
        acc[2] = value.un.accelerometer.z;
    } else if (value.sensorId == SH2_GYROSCOPE_CALIBRATED) {
        gyrTime = now;
        gyr[0] = value.un.gyroscope.x;
        gyr[1] = value.un.gyroscope.y;
        gyr[2] = value.un.gyroscope.z;
    } else if (value.sensorId == SH2_GAME_ROTATION_VECTOR && now - accTime < 2 * PERIOD_US) {
        p->t_us = now;
        p->fields = EDGEPOSE_QUAT | EDGEPOSE_ACC;
        p->quat[0] = value.un.gameRotationVector.real;
        p->quat[1] = value.un.gameRotationVector.i;
        p->quat[2] = value.un.gameRotationVector.j;
        p->quat[3] = value.un.gameRotationVector.k;
        memcpy(p->acc, acc, sizeof acc);
        if (now - gyrTime < 2 * PERIOD_US) {
            p->fields |= EDGEPOSE_GYR;
            memcpy(p->gyr, gyr, sizeof gyr);
        }
        return true;
    }
    return false;
}

#else

static const char FIRMWARE[] = "edgepose_sketch 1 made-up data";
static const uint8_t FRAME = EDGEPOSE_FRAME_UNKNOWN;
static uint32_t lastRead[SENSOR_COUNT];

static bool beginSensor(uint8_t i) {
    lastRead[i] = micros();
    return true; /* false if it does not answer */
}

static bool readSensor(uint8_t i, edgepose_packet *p) {
    if (micros() - lastRead[i] < PERIOD_US) return false; /* nothing new yet */
    lastRead[i] += PERIOD_US;
    p->t_us = lastRead[i];
    p->fields = EDGEPOSE_QUAT | EDGEPOSE_ACC | EDGEPOSE_GYR; /* leave out what the sensor does not measure */
    p->quat[0] = 1.0f; /* w, x, y, z: sensor frame to a frame with Z up */
    p->acc[2] = 9.81f; /* m/s^2, gravity included: a sensor in g needs * 9.80665f */
    p->gyr[0] = 0.0f;  /* rad/s: a sensor in deg/s needs * 0.01745329f */
    return true;
}

#endif

/* --- the line ---------------------------------------------------------------------------------------------------------- */

#if LINK == LINK_ESP32_CAN

#include <driver/twai.h>

static const gpio_num_t CAN_TX = GPIO_NUM_5, CAN_RX = GPIO_NUM_4;
static edgepose_can_clock canClocks[SENSOR_COUNT];

static void beginLine() {
    twai_general_config_t general = TWAI_GENERAL_CONFIG_DEFAULT(CAN_TX, CAN_RX, TWAI_MODE_NORMAL);
    twai_timing_config_t timing = TWAI_TIMING_CONFIG_1MBITS();
    twai_filter_config_t filter = TWAI_FILTER_CONFIG_ACCEPT_ALL();
    general.tx_queue_len = 4 * SENSOR_COUNT;
    twai_driver_install(&general, &timing, &filter);
    twai_start();
}

static void sendPacket(const edgepose_packet *p) {
    edgepose_can_frame frames[EDGEPOSE_CAN_MAX_FRAMES];
    const uint16_t ticks = edgepose_can_ticks(&canClocks[p->sensor_id - FIRST_ID], p->t_us);
    const size_t n = edgepose_can_encode(p, EDGEPOSE_CAN_BASE, ticks, frames);
    for (size_t i = 0; i < n; i++) {
        twai_message_t message = {};
        message.identifier = frames[i].id;
        message.data_length_code = frames[i].length;
        memcpy(message.data, frames[i].data, frames[i].length);
        twai_transmit(&message, 0); /* a full queue loses the frame; the receiver detects that */
    }
}

static void sendInfo(const edgepose_info *) {} /* CAN 2.0 has no INFO */

#elif LINK == LINK_ESP32_WIFI

#include <WiFi.h>
#include <WiFiUdp.h>

static const char NETWORK[] = "name of your network", PASSWORD[] = "its password";
static const IPAddress COMPUTER(192, 168, 1, 10); /* where edgepose runs */
static const uint16_t UDP_PORT = 9000;
static WiFiUDP udp;

static void beginLine() {
    WiFi.mode(WIFI_STA);
    WiFi.setSleep(false); /* the radio would hold packets back for up to a tenth of a second */
    WiFi.begin(NETWORK, PASSWORD);
    while (WiFi.status() != WL_CONNECTED) delay(100);
}

static void sendDatagram(const uint8_t *wire, size_t n) {
    if (!udp.beginPacket(COMPUTER, UDP_PORT)) return; /* not connected: the receiver detects the loss */
    udp.write(wire, n);
    udp.endPacket();
}

static void sendPacket(const edgepose_packet *p) {
    uint8_t wire[EDGEPOSE_MAX_WIRE];
    sendDatagram(wire, edgepose_encode(p, wire));
}

static void sendInfo(const edgepose_info *info) {
    uint8_t wire[EDGEPOSE_MAX_WIRE];
    sendDatagram(wire, edgepose_encode_info(info, wire));
}

#else

static void beginLine() {
    Serial.begin(BAUD);
    Serial.write((uint8_t)0); /* ends any noise that the line has picked up */
}

static void sendPacket(const edgepose_packet *p) {
    uint8_t wire[EDGEPOSE_MAX_WIRE];
    Serial.write(wire, edgepose_encode(p, wire));
}

static void sendInfo(const edgepose_info *info) {
    uint8_t wire[EDGEPOSE_MAX_WIRE];
    Serial.write(wire, edgepose_encode_info(info, wire));
}

#endif

/* --- the program ------------------------------------------------------------------------------------------------------- */

static uint16_t seq[SENSOR_COUNT];
static uint32_t lastInfo;

static void describeSensors() {
    for (uint8_t i = 0; i < SENSOR_COUNT; i++) {
        edgepose_info info = {};
        info.sensor_id = (uint8_t)(FIRST_ID + i);
        info.segment = info.sensor_id < 6 ? SEGMENTS[info.sensor_id] : (uint8_t)EDGEPOSE_NO_SEGMENT;
        info.frame = FRAME;
        info.rate_dhz = (uint16_t)(10000000u / PERIOD_US);
        info.firmware = FIRMWARE;
        sendInfo(&info);
    }
    lastInfo = millis();
}

void setup() {
    beginLine();
    for (uint8_t i = 0; i < SENSOR_COUNT; i++) {
        while (!beginSensor(i)) delay(500);
    }
    describeSensors();
}

void loop() {
    for (uint8_t i = 0; i < SENSOR_COUNT; i++) {
        edgepose_packet p = {};
        if (!readSensor(i, &p)) continue;
        p.sensor_id = (uint8_t)(FIRST_ID + i);
        p.seq = seq[i]++;
        sendPacket(&p);
    }
    if (millis() - lastInfo >= INFO_PERIOD_MS) describeSensors();
}
