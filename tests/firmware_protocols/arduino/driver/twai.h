/* A CAN controller that prints frames: identifier, colon, data. */
#pragma once
#include "../Arduino.h"

enum gpio_num_t { GPIO_NUM_4 = 4, GPIO_NUM_5 = 5 };
enum twai_mode_t { TWAI_MODE_NORMAL };
struct twai_general_config_t {
    twai_mode_t mode;
    gpio_num_t tx, rx;
    uint32_t tx_queue_len;
};
struct twai_timing_config_t {
    uint32_t bits_a_second;
};
struct twai_filter_config_t {
    uint32_t mask;
};
struct twai_message_t {
    uint32_t extd : 1;
    uint32_t identifier;
    uint8_t data_length_code;
    uint8_t data[8];
};
#define TWAI_GENERAL_CONFIG_DEFAULT(tx, rx, mode) {mode, tx, rx, 5}
#define TWAI_TIMING_CONFIG_1MBITS() {1000000}
#define TWAI_FILTER_CONFIG_ACCEPT_ALL() {0xFFFFFFFF}

inline int twai_driver_install(
    const twai_general_config_t *, const twai_timing_config_t *, const twai_filter_config_t *) {
    return 0;
}
inline int twai_start() { return 0; }
inline int twai_transmit(const twai_message_t *message, uint32_t) {
    printf("%x:", (unsigned)message->identifier);
    for (int i = 0; i < message->data_length_code; i++) printf("%02x", message->data[i]);
    printf("\n");
    return 0;
}
