/* As much of the Arduino core as the sketch needs; time is a number that run_sketch.cpp moves on. */
#pragma once
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <string.h>

extern uint64_t now_us;
inline uint32_t micros() { return (uint32_t)now_us; }
inline uint32_t millis() { return (uint32_t)(now_us / 1000); }
inline void delay(uint32_t ms) { now_us += 1000 * ms; }

struct SerialPort {
    void begin(unsigned long) {}
    size_t write(uint8_t byte) { return fwrite(&byte, 1, 1, stdout); }
    size_t write(const uint8_t *data, size_t n) { return fwrite(data, 1, n, stdout); }
};
extern SerialPort Serial;

void setup();
void loop();
