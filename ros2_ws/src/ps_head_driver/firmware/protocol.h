/* Wire protocol of docs/protocol.md: packets in and out. Knows no board and no head. */
#ifndef PS_PROTOCOL_H
#define PS_PROTOCOL_H

#include <stdbool.h>
#include <stdint.h>

#define PS_VERSION 1
#define PS_MAX_BODY 56
#define PS_MAX_PACKET (4 + PS_MAX_BODY + 2) /* header, body, CRC */
#define PS_MAX_WIRE (PS_MAX_PACKET + 2)     /* one COBS code byte and the delimiter */
#define PS_REPLY 0x80
#define PS_PANELS 8 /* bright field E N W S, dark field E N W S */
#define PS_STEP_SIZE 16
#define PS_STEPS_PER_PACKET 3
#define PS_NO_MOTOR INT32_MIN
#define PS_NOT_MEASURED 0xFFFF

enum ps_command {
    PS_HELLO = 1, PS_STATUS, PS_LIMITS, PS_HOME, PS_MOVE, PS_STOP, PS_SERVO, PS_GAINS, PS_STEPS,
    PS_START, PS_RECORD, PS_CLEAR_FAULT
};

enum ps_result {
    PS_OK, PS_UNKNOWN_COMMAND, PS_BAD_LENGTH, PS_WRONG_SESSION, PS_WRONG_VERSION, PS_UNSUPPORTED,
    PS_BUSY, PS_NOT_HOMED, PS_OUT_OF_LIMITS, PS_BAD_VALUE, PS_REJECTED, PS_FAULT
};

enum ps_capability { PS_MOTOR = 1, PS_LIGHTS = 2 };
enum ps_activity { PS_IDLE, PS_HOMING, PS_MOVING, PS_STROBING, PS_STOPPING };
enum ps_end { PS_END_NONE, PS_END_DONE, PS_END_STOPPED, PS_END_FAULT };
enum ps_flag { PS_HOMED = 1, PS_HOME_SWITCH = 2, PS_PANELS_ON = 4 };
enum ps_fault {
    PS_STALL = 1, PS_LIMIT = 2, PS_OVER_TEMPERATURE = 4, PS_LED_OPEN = 8, PS_WATCHDOG = 16
};

struct ps_packet {
    uint8_t type, sequence;
    uint16_t session;
    uint16_t crc; /* of all the rest; with the sequence it tells a retry */
    uint8_t length;
    uint8_t body[PS_MAX_BODY];
};

/* Finds packets in a stream of bytes. Start with all zero. */
struct ps_decoder {
    uint8_t frame[PS_MAX_WIRE - 1];
    uint8_t length;
    bool too_long;
};

/* CRC-16/CCITT-FALSE. */
uint16_t ps_crc(const uint8_t *data, uint8_t length);

/* Takes one byte of the line; true if it completed a packet. Damaged frames are dropped. */
bool ps_decode(struct ps_decoder *decoder, uint8_t byte, struct ps_packet *packet);

/* Writes the wire bytes of a packet, at most PS_MAX_WIRE, and returns how many. */
uint8_t ps_encode(const struct ps_packet *packet, uint8_t *wire);

/* Little-endian numbers; put appends to the body of a packet. */
uint16_t ps_get16(const uint8_t *data);
uint32_t ps_get32(const uint8_t *data);
void ps_put8(struct ps_packet *packet, uint8_t value);
void ps_put16(struct ps_packet *packet, uint16_t value);
void ps_put32(struct ps_packet *packet, uint32_t value);
void ps_put64(struct ps_packet *packet, uint64_t value);

#endif
