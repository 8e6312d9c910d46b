'use strict';
/* Joins a bus that a hub serves on TCP in the protocol of socketcand, and tells a canopen Device what comes there. */

const net = require('net');

/* The stack takes one function of a native module, the checksum of block transfers; it is written out here so that
 * nothing has to be compiled. CRC-16/XMODEM, CiA 301 7.2.4.3.16. */
function crc16(data) {
    let crc = 0;
    for (const byte of data) {
        crc ^= byte << 8;
        for (let bit = 0; bit < 8; ++bit)
            crc = (crc & 0x8000 ? crc << 1 ^ 0x1021 : crc << 1) & 0xffff;
    }
    const out = Buffer.alloc(2);
    out.writeUInt16BE(crc);
    return out;
}

const path = require.resolve('node-crc');
require.cache[path] = {
    id: path, filename: path, loaded: true,
    exports: { crc: (bits, reflected, polynomial, initial, xor, a, b, c, data) => crc16(data) },
};

const canopen = require('canopen');

function join({ host, port, channel }, device) {
    const socket = net.connect({ host, port, noDelay: true });
    let text = '', greetings = 0;
    const say = (message) => {
        const bytes = [...message.data].map((byte) => byte.toString(16)).join(' ');
        const id = message.id.toString(16).toUpperCase().padStart(3, '0');
        socket.write(`< send ${id} ${message.data.length.toString(16)} ${bytes} >`);
    };
    device.addListener('message', (message) => say(message));
    return new Promise((resolve, reject) => {
        socket.on('error', reject);
        socket.on('close', () => process.exit(0));
        socket.on('data', (chunk) => {
            text += chunk.toString('latin1');
            for (let end = text.indexOf('>'); end >= 0; end = text.indexOf('>')) {
                const words = text.slice(0, end).trim().split(/\s+/);
                text = text.slice(end + 1);
                if (words[1] === 'frame') {
                    const data = Buffer.from(words[4] || '', 'hex');
                    device.receive({ id: parseInt(words[2], 16), data, len: data.length });
                }
                else {
                    greetings += 1;
                    if (greetings === 1) socket.write(`< open ${channel} >`);
                    else if (greetings === 2) socket.write('< rawmode >');
                    else if (greetings === 3) resolve();
                }
            }
        });
    });
}

const tell = (event, more = {}) => process.stdout.write(JSON.stringify({ event, ...more }) + '\n');
const settings = JSON.parse(process.argv[2]);
process.stdin.resume();
process.stdin.on('end', () => process.exit(0));

module.exports = { canopen, join, tell, settings };
