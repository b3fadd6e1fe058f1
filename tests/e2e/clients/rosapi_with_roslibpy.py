"""An unmodified roslibpy user calls services of rosapi, and roslibpy's helpers for parameters and time.

Arguments: websocket URL, access token, calls as JSON (service, type, arguments), parameters as JSON (name,
new value). Prints the answers as JSON.
"""

import json
import sys

import roslibpy

SECONDS = 20
url, token, calls, parameters = sys.argv[1:]
ros = roslibpy.Ros(host=url, headers={"Authorization": f"Bearer {token}"})
ros.run(timeout=SECONDS)

answers = []
for service, type_name, arguments in json.loads(calls):
    request = roslibpy.ServiceRequest(arguments)
    answers.append(dict(roslibpy.Service(ros, service, type_name).call(request, timeout=SECONDS)))

values = {}
for name, new in json.loads(parameters):
    parameter = roslibpy.Param(ros, name)
    before = parameter.get(timeout=SECONDS)
    parameter.set(new, timeout=SECONDS)
    after = parameter.get(timeout=SECONDS)
    parameter.set(before, timeout=SECONDS)
    values[name] = [before, after, parameter.get(timeout=SECONDS)]

seen = {"answers": answers, "values": values, "names": ros.get_params(), "time": ros.get_time().to_sec()}
ros.terminate()
print(json.dumps(seen))
