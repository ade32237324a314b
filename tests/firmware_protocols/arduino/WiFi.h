/* As much of the ESP32's Wi-Fi library as the sketch needs; the network answers at the third look. */
#pragma once
#include <stdint.h>

enum { WIFI_STA = 1, WL_CONNECTED = 3, WL_DISCONNECTED = 6 };

struct IPAddress {
    uint8_t bytes[4];
    IPAddress(uint8_t a, uint8_t b, uint8_t c, uint8_t d) : bytes{a, b, c, d} {}
};

struct WiFiClass {
    int looks = 0;
    bool begun = false;
    void mode(int) {}
    void setSleep(bool) {}
    void begin(const char *, const char *) { begun = true; }
    int status() { return begun && ++looks > 2 ? WL_CONNECTED : WL_DISCONNECTED; }
};
static WiFiClass WiFi;
