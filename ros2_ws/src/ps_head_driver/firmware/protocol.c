#include "protocol.h"

#include <string.h>

uint16_t ps_crc(const uint8_t *data, uint8_t length)
{
    uint16_t crc = 0xFFFF;
    while (length--) {
        crc ^= (uint16_t)(*data++ << 8);
        for (uint8_t bit = 0; bit < 8; bit++)
            crc = (uint16_t)(crc & 0x8000 ? (crc << 1) ^ 0x1021 : crc << 1);
    }
    return crc;
}

/* Undoes COBS in place; the length of the content, 0 if the frame is damaged. */
static uint8_t unstuff(uint8_t *frame, uint8_t length)
{
    uint8_t in = 0, out = 0;
    while (in < length) {
        uint8_t code = frame[in];
        if (code == 0 || code > length - in)
            return 0;
        if (in) /* between two blocks stood a zero */
            frame[out++] = 0;
        memmove(frame + out, frame + in + 1, code - 1);
        out = (uint8_t)(out + code - 1);
        in += code;
    }
    return out;
}

static bool parse(const uint8_t *content, uint8_t length, struct ps_packet *packet)
{
    if (length < 6 || length > PS_MAX_PACKET)
        return false;
    packet->length = length - 6;
    packet->crc = ps_get16(content + length - 2);
    if (ps_crc(content, length - 2) != packet->crc)
        return false;
    packet->type = content[0];
    packet->sequence = content[1];
    packet->session = ps_get16(content + 2);
    memcpy(packet->body, content + 4, packet->length);
    return true;
}

bool ps_decode(struct ps_decoder *decoder, uint8_t byte, struct ps_packet *packet)
{
    if (byte) {
        if (decoder->length < sizeof decoder->frame)
            decoder->frame[decoder->length++] = byte;
        else
            decoder->too_long = true;
        return false;
    }
    uint8_t content = decoder->too_long ? 0 : unstuff(decoder->frame, decoder->length);
    decoder->length = 0;
    decoder->too_long = false;
    return parse(decoder->frame, content, packet);
}

uint8_t ps_encode(const struct ps_packet *packet, uint8_t *wire)
{
    uint8_t content[PS_MAX_PACKET];
    uint8_t length = 4 + packet->length;
    content[0] = packet->type;
    content[1] = packet->sequence;
    content[2] = (uint8_t)packet->session;
    content[3] = (uint8_t)(packet->session >> 8);
    memcpy(content + 4, packet->body, packet->length);
    uint16_t crc = ps_crc(content, length);
    content[length++] = (uint8_t)crc;
    content[length++] = (uint8_t)(crc >> 8);

    uint8_t block = 0, out = 1; /* where the code byte of this block stands */
    for (uint8_t i = 0; i < length; i++) {
        if (content[i]) {
            wire[out++] = content[i];
        } else {
            wire[block] = out - block;
            block = out++;
        }
    }
    wire[block] = out - block;
    wire[out++] = 0;
    return out;
}

uint16_t ps_get16(const uint8_t *data)
{
    return (uint16_t)(data[0] | (uint16_t)data[1] << 8);
}

uint32_t ps_get32(const uint8_t *data)
{
    return ps_get16(data) | (uint32_t)ps_get16(data + 2) << 16;
}

void ps_put8(struct ps_packet *packet, uint8_t value)
{
    if (packet->length < PS_MAX_BODY)
        packet->body[packet->length++] = value;
}

void ps_put16(struct ps_packet *packet, uint16_t value)
{
    ps_put8(packet, (uint8_t)value);
    ps_put8(packet, (uint8_t)(value >> 8));
}

void ps_put32(struct ps_packet *packet, uint32_t value)
{
    ps_put16(packet, (uint16_t)value);
    ps_put16(packet, (uint16_t)(value >> 16));
}

void ps_put64(struct ps_packet *packet, uint64_t value)
{
    ps_put32(packet, (uint32_t)value);
    ps_put32(packet, (uint32_t)(value >> 32));
}
