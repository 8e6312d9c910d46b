'use strict';
/* A CANopen slave of another make; what it is and has is told on the command line as JSON. */

const { canopen, join, tell, settings } = require('./link');
const { Device, DataType, AccessType, ObjectType } = canopen;

const device = new Device({ id: settings.node });
const eds = device.eds;
const nodeId = settings.node;

eds.addSdoServerParameter(0, 0x580 + nodeId, 0x600 + nodeId);
eds.setIdentity(settings.identity);
eds.setDeviceName(settings.name);
if (settings.heartbeat_ms) eds.setHeartbeatProducerTime(settings.heartbeat_ms);
eds.setSyncCobId(0x80);

for (const [index, name, type, value] of settings.objects) {
    const entry = eds.getEntry(index) || eds.addEntry(index, {
        parameterName: name, objectType: ObjectType.VAR, dataType: DataType[type], accessType: AccessType.READ_WRITE,
    });
    entry.value = value;
}
for (const { cobId, kind, objects } of settings.tpdos)
    eds.addTransmitPdo({
        cobId: cobId + nodeId, transmissionType: kind, dataObjects: objects.map((index) => eds.getEntry(index)),
    });

join(settings.bus, device).then(() => {
    device.start();
    tell('ready');
});
