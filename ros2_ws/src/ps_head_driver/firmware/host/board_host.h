/* A board that is not there: motor, panels and line as variables, on a virtual or the real clock. */
#ifndef PS_BOARD_HOST_H
#define PS_BOARD_HOST_H

#include <stdbool.h>
#include <stdint.h>

#define HOST_BUFFER 8192

struct host {
    uint64_t time_us; /* of power-up to now */
    bool real_time;
    uint8_t capabilities;
    /* the line */
    uint8_t input[HOST_BUFFER], output[HOST_BUFFER];
    uint32_t input_length, input_read, output_length;
    /* faults to inject */
    bool stalled;
    uint8_t open_panels;
    uint16_t heat; /* of panel 5, 0.01 K */
    /* what the world sees */
    int32_t position; /* of the motor, counts of the homed system */
    uint8_t lit;      /* mask */
    uint32_t triggers;
    uint64_t dark_since_us;
};

extern struct host host;

/* Power-up with the motor somewhere; a session begins with it. */
void host_power_up(uint8_t capabilities, int32_t position);

/* Lets time pass. */
void host_advance(uint64_t until_us);

/* Bytes from the host computer; returns what the board answers, in host.output. */
uint32_t host_receive(const uint8_t *data, uint32_t length);

#endif
