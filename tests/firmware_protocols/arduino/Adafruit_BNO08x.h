/* A sensor that answers the second begin, lies still upside down, reports its reset once, and mixes up its reports' order. */
#pragma once
#include "Arduino.h"

enum { SH2_ACCELEROMETER = 1, SH2_GYROSCOPE_CALIBRATED = 2, SH2_GAME_ROTATION_VECTOR = 8 };

struct sh2_SensorValue_t {
    uint8_t sensorId;
    union {
        struct { float x, y, z; } accelerometer, gyroscope;
        struct { float i, j, k, real; } gameRotationVector;
    } un;
};

class Adafruit_BNO08x {
  public:
    explicit Adafruit_BNO08x(int8_t) {}
    bool begin_I2C() { return ++begins_ > 1; }
    bool wasReset() { return resets_++ == 0; }
    bool enableReport(uint8_t id, uint32_t) { return (enabled_ |= 1u << id) != 0; }
    bool getSensorEvent(sh2_SensorValue_t *value) {
        const uint32_t cycle = (uint32_t)(now_us / 10000);
        if (enabled_ != (1u << 1 | 1u << 2 | 1u << 8)) return false;
        if (cycle != cycle_) {
            cycle_ = cycle;
            left_ = 3;
        }
        if (left_ == 0) return false;
        left_--;
        switch ((left_ + cycle) % 3) {
            case 0:
                value->sensorId = SH2_ACCELEROMETER;
                value->un.accelerometer = {0.0f, 0.0f, -9.81f};
                break;
            case 1:
                value->sensorId = SH2_GYROSCOPE_CALIBRATED;
                value->un.gyroscope = {0.5f, 0.0f, -0.5f};
                break;
            default:
                value->sensorId = SH2_GAME_ROTATION_VECTOR;
                value->un.gameRotationVector = {1.0f, 0.0f, 0.0f, 0.0f};
        }
        return true;
    }

  private:
    int begins_ = 0, resets_ = 0, left_ = 0;
    uint32_t enabled_ = 0, cycle_ = 0;
};
