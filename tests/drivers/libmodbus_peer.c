/* A Modbus unit, and a master, of libmodbus: an implementation that shares nothing with fdhil's or pymodbus'.
 *
 *   libmodbus_peer tcp-unit                      prints its port, then serves connections one after the other
 *   libmodbus_peer rtu-unit DEVICE UNIT VOLTS    prints "ready", then serves
 *   libmodbus_peer tcp-master HOST PORT ADDRESS  prints the float32 in two input registers
 *   libmodbus_peer rtu-master DEVICE UNIT ADDRESS
 *
 * Registers of a unit (the same as input and holding registers): 0-1 float32, 2-3 the same with the low word first,
 * 4 int16 in 0.01 V, 5-6 int32 in 0.1 mV with the low word first, 7 writable.
 */
#include <arpa/inet.h>
#include <errno.h>
#include <modbus.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <unistd.h>

static int fail(const char *what) {
    fprintf(stderr, "%s: %s\n", what, modbus_strerror(errno));
    return 1;
}

static void fill(modbus_mapping_t *map, float volts) {
    int mV10 = (int)(volts * 10000);
    uint16_t *in = map->tab_input_registers;
    uint32_t bits; /* not modbus_set_float_abcd: that of 3.1.6 mixes the bytes, modbus_get_float_abcd does not */
    memcpy(&bits, &volts, sizeof bits);
    in[0] = in[3] = (uint16_t)(bits >> 16);
    in[1] = in[2] = (uint16_t)bits;
    in[4] = (uint16_t)(int16_t)(volts * 100);
    in[5] = (uint16_t)(mV10 & 0xFFFF);
    in[6] = (uint16_t)((unsigned)mV10 >> 16);
    memcpy(map->tab_registers, in, 8 * sizeof(uint16_t));
}

static void serve(modbus_t *bus, modbus_mapping_t *map) {
    uint8_t query[MODBUS_MAX_ADU_LENGTH];
    for (;;) {
        int length = modbus_receive(bus, query);
        if (length > 0) modbus_reply(bus, query, length, map);
        else if (length < 0 && errno != EMBBADCRC && errno != ETIMEDOUT && errno != EMBBADDATA) return;
    }
}

static int tcp_unit(void) {
    modbus_t *bus = modbus_new_tcp("127.0.0.1", 0);
    modbus_mapping_t *map = modbus_mapping_new(0, 0, 8, 8);
    struct sockaddr_in where;
    socklen_t size = sizeof where;
    int listening = modbus_tcp_listen(bus, 1);
    if (listening < 0) return fail("listen");
    getsockname(listening, (struct sockaddr *)&where, &size);
    fill(map, -12.34f);
    printf("%d\n", ntohs(where.sin_port));
    fflush(stdout);
    while (modbus_tcp_accept(bus, &listening) >= 0) {
        serve(bus, map);
        modbus_close(bus);
    }
    return fail("accept");
}

static modbus_t *rtu(const char *device, int unit) {
    modbus_t *bus = modbus_new_rtu(device, 115200, 'N', 8, 1); /* a pseudo terminal has no parity */
    modbus_set_slave(bus, unit);
    return modbus_connect(bus) < 0 ? NULL : bus;
}

static int rtu_unit(const char *device, int unit, float volts) {
    modbus_t *bus = rtu(device, unit);
    modbus_mapping_t *map = modbus_mapping_new(0, 0, 8, 8);
    if (!bus) return fail("open");
    fill(map, volts);
    puts("ready");
    fflush(stdout);
    serve(bus, map);
    return fail("receive");
}

static int master(modbus_t *bus, int address) {
    uint16_t words[2];
    if (!bus) return fail("open");
    modbus_set_response_timeout(bus, 60, 0); /* of a computer that is busy, as are those below */
    modbus_set_byte_timeout(bus, 60, 0);
    if (modbus_read_input_registers(bus, address, 2, words) != 2) return fail("read");
    printf("%.4f\n", modbus_get_float_abcd(words));
    return 0;
}

int main(int argc, char **argv) {
    if (argc == 2 && !strcmp(argv[1], "tcp-unit")) return tcp_unit();
    if (argc == 5 && !strcmp(argv[1], "rtu-unit")) return rtu_unit(argv[2], atoi(argv[3]), (float)atof(argv[4]));
    if (argc == 5 && !strcmp(argv[1], "rtu-master")) return master(rtu(argv[2], atoi(argv[3])), atoi(argv[4]));
    if (argc == 5 && !strcmp(argv[1], "tcp-master")) {
        modbus_t *bus = modbus_new_tcp(argv[2], atoi(argv[3]));
        return master(modbus_connect(bus) < 0 ? NULL : bus, atoi(argv[4]));
    }
    return 2;
}
