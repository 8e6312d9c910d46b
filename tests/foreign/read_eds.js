'use strict';
/* Reads an EDS file with a CANopen stack of another make and tells what it found, as one JSON document. */

const { canopen, settings } = require('./link');

const eds = canopen.Eds.fromFile(settings.file);
const objects = {};
const tell = (index, sub, entry) => {
    const value = typeof entry.value === 'bigint' ? Number(entry.value) : entry.value;
    objects[`${index}:${sub}`] = { type: entry.dataType, access: entry.accessType, value };
};
for (const [, entry] of eds.entries()) {
    if (!entry.subNumber) tell(entry.index, 0, entry);
    for (let sub = 0; entry.subNumber && sub < 256; ++sub)
        if (entry.at(sub)) tell(entry.index, sub, entry.at(sub));
}
const mapped = (pdos) => pdos.map((pdo) => pdo.dataObjects.map((entry) => entry.index));
process.stdout.write(JSON.stringify({
    vendor: eds.vendorNumber, objects, tpdos: mapped(eds.getTransmitPdos()), rpdos: mapped(eds.getReceivePdos()),
}));
