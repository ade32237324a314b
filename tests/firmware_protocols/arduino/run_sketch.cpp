/* Runs a sketch for a number of seconds of a clock of its own; what it sends goes to standard output. */
#include <stdlib.h>

#include "Arduino.h"

uint64_t now_us = 4294000000u; /* micros() wraps in the first second */
SerialPort Serial;

int main(int, char **argv) {
    setup();
    for (int i = 0; i < 4000 * atoi(argv[1]); i++) {
        loop();
        now_us += 250;
    }
    return 0;
}
