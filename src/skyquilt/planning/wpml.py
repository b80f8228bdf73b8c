"""DJI's waypoint files (WPML 1.0.2): an archive of `wpmz/template.kml` and `wpmz/waylines.wpml`."""

import io
import zipfile

from skyquilt.planning.stops import Flight, Stop

NAMESPACE = "http://www.dji.com/wpmz/1.0.2"


def dji(flight: Flight) -> bytes:
    """A `.kmz` of DJI's waypoint format (WPML): a photo taken at each point, whose heading is
    held.
    """
    config = (
        "<wpml:missionConfig>"
        "<wpml:flyToWaylineMode>safely</wpml:flyToWaylineMode>"
        "<wpml:finishAction>goHome</wpml:finishAction>"
        "<wpml:exitOnRCLost>executeLostAction</wpml:exitOnRCLost>"
        "<wpml:executeRCLostAction>goBack</wpml:executeRCLostAction>"
        f"<wpml:takeOffSecurityHeight>{max(20.0, min(flight.stops[0].height, 1500)):g}"
        "</wpml:takeOffSecurityHeight>"
        f"<wpml:globalTransitionalSpeed>{flight.drone.speed_ms:g}</wpml:globalTransitionalSpeed>"
        "<wpml:droneInfo><wpml:droneEnumValue>68</wpml:droneEnumValue>"
        "<wpml:droneSubEnumValue>0</wpml:droneSubEnumValue></wpml:droneInfo>"
        "</wpml:missionConfig>"
    )
    head = (
        '<?xml version="1.0" encoding="UTF-8"?>\n<kml xmlns="http://www.opengis.net/kml/2.2"'
        f' xmlns:wpml="{NAMESPACE}"><Document>'
    )
    times = "<wpml:createTime>0</wpml:createTime><wpml:updateTime>0</wpml:updateTime>"
    template = f"{head}{times}{config}<wpml:templateId>0</wpml:templateId></Document></kml>\n"
    marks = "".join(_placemark(k, s, flight) for k, s in enumerate(flight.stops))
    waylines = (
        f"{head}{config}<Folder><wpml:templateId>0</wpml:templateId>"
        "<wpml:executeHeightMode>relativeToStartPoint</wpml:executeHeightMode>"
        "<wpml:waylineId>0</wpml:waylineId>"
        f"<wpml:autoFlightSpeed>{flight.drone.speed_ms:g}</wpml:autoFlightSpeed>"
        f"{marks}</Folder></Document></kml>\n"
    )
    return zipped({"wpmz/template.kml": template, "wpmz/waylines.wpml": waylines})


def zipped(members: dict[str, str]) -> bytes:
    """An archive whose bytes depend on its content alone."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, text in members.items():
            about = zipfile.ZipInfo(name, (2020, 1, 1, 0, 0, 0))
            about.compress_type = zipfile.ZIP_DEFLATED
            archive.writestr(about, text)
    return buffer.getvalue()


def _placemark(index: int, stop: Stop, flight: Flight) -> str:
    turn = "toPointAndStopWithDiscontinuityCurvature"
    return (
        f"<Placemark><Point><coordinates>{stop.longitude:.8f},{stop.latitude:.8f}</coordinates>"
        f"</Point><wpml:index>{index}</wpml:index>"
        f"<wpml:executeHeight>{stop.height:g}</wpml:executeHeight>"
        f"<wpml:waypointSpeed>{flight.drone.speed_ms:g}</wpml:waypointSpeed>"
        "<wpml:waypointHeadingParam>"
        "<wpml:waypointHeadingMode>smoothTransition</wpml:waypointHeadingMode>"
        f"<wpml:waypointHeadingAngle>{stop.yaw:g}</wpml:waypointHeadingAngle>"
        "<wpml:waypointHeadingAngleEnable>1</wpml:waypointHeadingAngleEnable>"
        "<wpml:waypointHeadingPathMode>followBadArc</wpml:waypointHeadingPathMode>"
        "</wpml:waypointHeadingParam><wpml:waypointTurnParam>"
        f"<wpml:waypointTurnMode>{turn}</wpml:waypointTurnMode>"
        "<wpml:waypointTurnDampingDist>0</wpml:waypointTurnDampingDist>"
        "</wpml:waypointTurnParam><wpml:useStraightLine>1</wpml:useStraightLine>"
        f"{_actions(index, stop)}</Placemark>"
    )


def _actions(index: int, stop: Stop) -> str:
    """The gimbal turned down at the first place, and a photo."""
    found = []
    if index == 0:
        found.append(
            "<wpml:actionActuatorFunc>gimbalRotate</wpml:actionActuatorFunc>"
            "<wpml:actionActuatorFuncParam>"
            "<wpml:gimbalHeadingYawBase>aircraft</wpml:gimbalHeadingYawBase>"
            "<wpml:gimbalRotateMode>absoluteAngle</wpml:gimbalRotateMode>"
            "<wpml:gimbalPitchRotateEnable>1</wpml:gimbalPitchRotateEnable>"
            "<wpml:gimbalPitchRotateAngle>-90</wpml:gimbalPitchRotateAngle>"
            "<wpml:gimbalRollRotateEnable>0</wpml:gimbalRollRotateEnable>"
            "<wpml:gimbalYawRotateEnable>0</wpml:gimbalYawRotateEnable>"
            "<wpml:payloadPositionIndex>0</wpml:payloadPositionIndex>"
            "</wpml:actionActuatorFuncParam>"
        )
    if stop.photo:
        found.append(
            "<wpml:actionActuatorFunc>takePhoto</wpml:actionActuatorFunc>"
            f"<wpml:actionActuatorFuncParam><wpml:fileSuffix>point{index}</wpml:fileSuffix>"
            "<wpml:payloadPositionIndex>0</wpml:payloadPositionIndex>"
            "</wpml:actionActuatorFuncParam>"
        )
    if not found:
        return ""
    inner = "".join(
        f"<wpml:action><wpml:actionId>{k}</wpml:actionId>{text}</wpml:action>"
        for k, text in enumerate(found)
    )
    return (
        f"<wpml:actionGroup><wpml:actionGroupId>{index + 1}</wpml:actionGroupId>"
        f"<wpml:actionGroupStartIndex>{index}</wpml:actionGroupStartIndex>"
        f"<wpml:actionGroupEndIndex>{index}</wpml:actionGroupEndIndex>"
        "<wpml:actionGroupMode>sequence</wpml:actionGroupMode><wpml:actionTrigger>"
        "<wpml:actionTriggerType>reachPoint</wpml:actionTriggerType></wpml:actionTrigger>"
        f"{inner}</wpml:actionGroup>"
    )
