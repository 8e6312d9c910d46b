'use strict';
/* A CANopen master of another make: produces SYNC with a counter, starts a drive, enables it where it stands.
   It waits for the drive's answer to each SYNC: drive and master are processes that a busy computer holds up. */

const { canopen, join, tell, settings } = require('./link');
const { Device, DataType } = canopen;

const device = new Device({ id: settings.own_node });
const drive = settings.node;
device.eds.setSyncCobId(0x80);
device.eds.addSdoClientParameter(drive, 0x600 + drive, 0x580 + drive);

let counter = 0, answered = true, position = null, statusword = 0, controlword = 0, told = false;
const TOWARD = [[0x4f, 0x40, 0x06], [0x6f, 0x21, 0x07], [0x6f, 0x23, 0x0f], [0x6f, 0x27, 0x0f]]; // CiA 402-2, 6.3

function cycle() {
    if (!answered) return;
    answered = false;
    counter = settings.overflow ? counter % settings.overflow + 1 : 0;
    device.emit('message', { id: 0x80, data: Buffer.from(settings.overflow ? [counter] : []) });
    if (position === null) return;
    for (const [mask, value, word] of TOWARD)
        if ((statusword & mask) === value) controlword = word;
    const data = Buffer.alloc(6);
    data.writeUInt16LE(controlword, 0);
    data.writeInt32LE(position, 2);
    device.emit('message', { id: 0x200 + drive, data });
    if (!told && (statusword & 0x6f) === 0x27) {
        told = true;
        tell('enabled', { statusword, position });
    }
}

async function main() {
    await join(settings.bus, device);
    device.start();
    const read = (index, dataType, blockTransfer = false) =>
        device.sdo.upload({ deviceId: drive, index, dataType, blockTransfer, timeout: 60000 });
    tell('identity', {
        device_type: await read(0x1000, DataType.UNSIGNED32), name: await read(0x1008, DataType.VISIBLE_STRING),
        by_block: await read(0x1008, DataType.VISIBLE_STRING, true),
    });
    await device.sdo.download({ deviceId: drive, index: 0x6060, data: 8, dataType: DataType.INTEGER8, timeout: 60000 });
    position = await read(0x6064, DataType.INTEGER32);
    device.nmt.startNode(drive);
    const raw = device.receive.bind(device);
    device.receive = (message) => {
        if (message.id === 0x280 + drive) {
            statusword = message.data.readUInt16LE(0);
            answered = true;
        }
        raw(message);
    };
    setInterval(cycle, settings.period_ms);
}

main().catch((error) => { tell('error', { text: String(error) }); process.exit(1); });
