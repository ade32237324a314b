/* Datagrams, one in hexadecimal digits a line: "address:port data". */
#pragma once
#include <stdio.h>

#include "WiFi.h"

struct WiFiUDP {
    int beginPacket(IPAddress to, uint16_t port) {
        printf("%d.%d.%d.%d:%d ", to.bytes[0], to.bytes[1], to.bytes[2], to.bytes[3], port);
        return 1;
    }
    size_t write(const uint8_t *data, size_t n) {
        for (size_t i = 0; i < n; i++) printf("%02X", data[i]);
        return n;
    }
    int endPacket() { return puts("") >= 0; }
};
