/* Vectors shared with the Python side, and random bytes: unit_test VECTORS ROUNDS. */
#include <inttypes.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "board_host.h"
#include "protocol.h"

static int failures;

static void check(int good, const char *what)
{
    if (!good) {
        fprintf(stderr, "failed: %s\n", what);
        failures++;
    }
}

static uint32_t random_state = 1;

static uint32_t random_below(uint32_t limit)
{
    random_state ^= random_state << 13;
    random_state ^= random_state >> 17;
    random_state ^= random_state << 5;
    return random_state % limit;
}

static int from_hex(const char *text, uint8_t *bytes)
{
    int length = 0;
    for (unsigned value; sscanf(text, "%2x", &value) == 1; text += 2)
        bytes[length++] = (uint8_t)value;
    return length;
}

/* A line: type, sequence, session, body (hexadecimal, - if empty), wire bytes (hexadecimal). */
static void test_vector(const char *line)
{
    unsigned type, sequence, session;
    char body_text[2 * PS_MAX_BODY + 2], wire_text[2 * PS_MAX_WIRE + 1];
    uint8_t body[PS_MAX_BODY], wire[PS_MAX_WIRE], encoded[PS_MAX_WIRE];
    if (sscanf(line, "%x %x %x %113s %128s", &type, &sequence, &session, body_text, wire_text)
        != 5) {
        check(0, "a vector has five fields");
        return;
    }
    int body_length = body_text[0] == '-' ? 0 : from_hex(body_text, body);
    int wire_length = from_hex(wire_text, wire);

    struct ps_decoder decoder = {{0}, 0, false};
    struct ps_packet packet;
    int found = 0;
    for (int i = 0; i < wire_length; i++)
        found += ps_decode(&decoder, wire[i], &packet);
    check(found == 1, line);
    if (found != 1)
        return;
    check(packet.type == type && packet.sequence == sequence && packet.session == session, line);
    check(packet.length == body_length && !memcmp(packet.body, body, packet.length), line);
    check(ps_encode(&packet, encoded) == wire_length && !memcmp(encoded, wire, wire_length), line);

    int place = (int)random_below((uint32_t)wire_length - 1);
    wire[place] ^= (uint8_t)(1 + random_below(255)); /* any damaged byte is noticed */
    memset(&decoder, 0, sizeof decoder);
    for (int i = 0; i < wire_length; i++)
        if (ps_decode(&decoder, wire[i], &packet))
            check(packet.length != body_length || memcmp(packet.body, body, packet.length), line);
}

static int test_vectors(const char *path)
{
    char line[400];
    int count = 0;
    FILE *file = fopen(path, "r");
    check(file != NULL, path);
    while (file && fgets(line, sizeof line, file))
        if (line[0] != '#') {
            test_vector(line);
            count++;
        }
    if (file)
        fclose(file);
    return count;
}

/* Random packets with a right CRC, and noise, while time passes. */
static void test_noise(long rounds)
{
    host_power_up(3, 9000);
    for (long round = 0; round < rounds; round++) {
        uint8_t bytes[80];
        uint32_t length = random_below(sizeof bytes);
        for (uint32_t i = 0; i < length; i++)
            bytes[i] = (uint8_t)random_below(random_below(2) ? 256 : 4);
        if (random_below(4)) {
            struct ps_packet packet = {.session = 7};
            packet.type = (uint8_t)(1 + random_below(13));
            packet.sequence = (uint8_t)random_below(256);
            packet.length = (uint8_t)random_below(PS_MAX_BODY + 1);
            memcpy(packet.body, bytes, packet.length);
            if (packet.type == PS_HELLO)
                packet.length = 1;
            length = ps_encode(&packet, bytes);
        }
        host_receive(bytes, length);
        host_advance(host.time_us + random_below(3000));
    }
    host_advance(host.time_us + 1000000);
    check(host.lit == 0, "panels are off a second after the last request");
}

int main(int count, char **arguments)
{
    if (count != 3)
        return 2;
    check(ps_crc((const uint8_t *)"123456789", 9) == 0x29B1, "CRC of 123456789");
    int vectors = test_vectors(arguments[1]);
    check(vectors > 0, "there are vectors");
    long rounds = atol(arguments[2]);
    test_noise(rounds);
    printf("%d vectors, %ld rounds of noise, %d failures\n", vectors, rounds, failures);
    return failures != 0;
}
