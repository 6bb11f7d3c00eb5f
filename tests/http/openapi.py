"""Checks the document at URL/openapi.json against the rules of OpenAPI 3.1, then drives every operation from it: valid
requests are made from its examples and their answers held against its schemas; each field gets values that its schema
excludes, and the refusal must name the field. Prints what fails, and "N passed, N failed"."""

import copy
import json
import re
import sys
import urllib.error
import urllib.parse
import urllib.request

from jsonschema import Draft202012Validator
from jsonschema.exceptions import SchemaError

url = sys.argv[1]
counts = {True: 0, False: 0}


def check(good, name, found=""):
    counts[bool(good)] += 1
    if not good:
        print(f"FAILED: {name}\n        {str(found)[:600]}")
    return good


class Answer:
    def __init__(self, response):
        self.status, self.headers, self.body = response.status, response.headers, response.read()
        self.type = (self.headers.get("Content-Type") or "").split(";")[0]

    def json(self):
        return json.loads(self.body) if self.type.endswith("json") else self.body.decode()


def send(method, path, body=None, content_type=None, **headers):
    headers = {name.replace("_", "-"): value for name, value in headers.items()}
    if content_type:
        headers["Content-Type"] = content_type
        body = body if isinstance(body, str) else json.dumps(body)
    request = urllib.request.Request(url + path, body.encode() if body is not None else None, headers, method=method)
    try:
        with urllib.request.urlopen(request, timeout=60) as response:
            return Answer(response)
    except urllib.error.HTTPError as error:
        return Answer(error)


# ---- the document ----

document = send("GET", "/openapi.json").json()
components = document["components"]["schemas"]


def resolved(schema):
    while "$ref" in schema:
        schema = components[schema["$ref"].rsplit("/", 1)[1]]
    return schema


def strict(schema):
    """The schema with no members allowed but those it tells: what we answer must be told."""
    if isinstance(schema, list):
        return [strict(each) for each in schema]
    if not isinstance(schema, dict):
        return schema
    result = {key: strict(value) for key, value in schema.items() if key not in ("example", "default", "enum")}
    if "enum" in schema:
        result["enum"] = schema["enum"]
    if isinstance(schema.get("properties"), dict) and "additionalProperties" not in schema and "type" in schema:
        result["additionalProperties"] = False
    return result


def errors_of(value, schema, closed):
    whole = {"components": {"schemas": strict(components) if closed else components}}
    whole["components"]["schemas"]["_"] = strict(schema) if closed else schema
    whole["$ref"] = "#/components/schemas/_"
    found = [f"{'/'.join(map(str, e.absolute_path))}: {e.message[:200]}" for e in Draft202012Validator(whole).iter_errors(value)]
    del whole["components"]["schemas"]["_"]
    return found


def all_of(node, key):
    if isinstance(node, dict):
        if key in node:
            yield node[key]
        for value in node.values():
            yield from all_of(value, key)
    elif isinstance(node, list):
        for value in node:
            yield from all_of(value, key)


METHODS = {"get", "put", "post", "delete", "options", "head", "patch", "trace"}
check(re.fullmatch(r"3\.1\.\d+", document["openapi"]), "the version of OpenAPI", document["openapi"])
check(set(document) <= {"openapi", "info", "jsonSchemaDialect", "servers", "paths", "webhooks", "components", "security",
                        "tags", "externalDocs"}, "the document's members", list(document))
check(document["info"].get("title") and document["info"].get("version"), "title and version", document["info"])
for name, schema in components.items():
    check(re.fullmatch(r"[a-zA-Z0-9._-]+", name), "a component's name", name)
    try:
        Draft202012Validator.check_schema(schema)
        check(True, name)
    except SchemaError as error:
        check(False, f"schema {name}", error.message)
for reference in set(all_of(document, "$ref")):
    match = re.fullmatch(r"#/components/schemas/([a-zA-Z0-9._-]+)", reference)
    check(match and match[1] in components, "a reference that leads somewhere", reference)

operations = []
for path, item in document["paths"].items():
    check(path.startswith("/") and set(item) <= METHODS, f"the path {path}", list(item))
    for method, operation in item.items():
        operations.append((method.upper(), path, operation))
ids = [operation["operationId"] for _, _, operation in operations]
check(len(set(ids)) == len(ids), "operation ids are unique", ids)
for method, path, operation in operations:
    name = f"{method} {path}"
    check(set(operation) <= {"tags", "summary", "description", "operationId", "parameters", "requestBody", "responses"},
          f"{name}: members", list(operation))
    parameters = operation.get("parameters", [])
    check(len({(p["name"], p["in"]) for p in parameters}) == len(parameters), f"{name}: parameters are unique")
    check({p["name"] for p in parameters if p["in"] == "path"} == set(re.findall(r"{(\w+)}", path)),
          f"{name}: the template's names are parameters")
    for p in parameters:
        good = p["in"] in ("path", "query", "header") and p["required"] == (p["in"] == "path") and p["description"]
        good = good and p["name"].lower() not in ("accept", "content-type", "authorization")
        check(good and not list(Draft202012Validator(Draft202012Validator.META_SCHEMA).iter_errors(p["schema"])),
              f"{name}: parameter {p['name']}", p)
        if "example" in p:
            found = errors_of(p["example"], p["schema"], False)
            check(not found, f"{name}: example of {p['name']}", found)
    check(any(re.fullmatch("2..", status) for status in operation["responses"]), f"{name}: it may succeed")
    contents = list(operation.get("requestBody", {}).get("content", {}).items())
    check(("requestBody" in operation) == bool(contents), f"{name}: a body has a type")
    for status, response in operation["responses"].items():
        check(re.fullmatch("[1-5][0-9][0-9]|default", status) and response.get("description"), f"{name}: {status}", response)
        contents += list(response.get("content", {}).items())
    for content_type, content in contents:
        try:
            Draft202012Validator.check_schema(content["schema"])
            found = errors_of(content["example"], content["schema"], False) if "example" in content else []
            check(not found, f"{name}: example of {content_type}", found)
        except SchemaError as error:
            check(False, f"{name}: schema of {content_type}", error.message)

# ---- every operation ----


def documented(name, operation, answer):
    """The answer is one that the operation tells of, in a form that it tells of."""
    response = operation["responses"].get(str(answer.status))
    if not check(response, f"{name}: status {answer.status} is documented", answer.body[:300]):
        return
    contents = response.get("content", {})
    if not contents:
        check(not answer.body, f"{name}: {answer.status} has no body", answer.body[:300])
        return
    if check(answer.type in contents, f"{name}: type {answer.type} of {answer.status} is documented", list(contents)):
        found = errors_of(answer.json(), contents[answer.type]["schema"], True)
        check(not found, f"{name}: the body of {answer.status} satisfies its schema", found)


problem = {"$ref": "#/components/schemas/Problem"}


def refused(name, answer, status, pointer=None):
    """A problem of one of the statuses; one of its errors stands at the pointer, or within."""
    statuses = status if isinstance(status, tuple) else (status,)
    good = answer.status in statuses and answer.type == "application/problem+json"
    if not check(good, name, f"{answer.status} {answer.type} {answer.body[:300]}"):
        return
    body = answer.json()
    found = errors_of(body, problem, True)
    check(not found, f"{name}: the problem satisfies its schema", found)
    if pointer is not None:
        check(any(e["pointer"] == pointer or e["pointer"].startswith(pointer + "/") for e in body.get("errors", [])),
              f"{name}: the error stands at {pointer}", body.get("errors"))


def wrong_values(schema):
    """Values that a schema excludes."""
    schema = resolved(schema)
    kind = schema.get("type")
    if "anyOf" in schema or "const" in schema:
        yield True
        return
    yield {"number": "x", "integer": "x", "boolean": "x", "string": 1, "array": "x", "object": 1}.get(kind, True)
    if "enum" in schema:
        yield "nonsense"
    if kind == "integer":
        yield 1.5
    if "maxLength" in schema:
        yield "x" * (schema["maxLength"] + 1)
    for limit, beyond in (("minimum", -1), ("exclusiveMinimum", 0), ("maximum", 1), ("exclusiveMaximum", 0)):
        if limit in schema and schema[limit] < 1e15:
            yield schema[limit] + beyond * max(1, abs(schema[limit]) * 1e-3)
    if kind == "array" and schema.get("minItems", 0) > 0:
        yield []
    if kind == "array":
        for value in wrong_values(schema["items"]):
            yield [value]


def escaped(key):
    return key.replace("~", "~0").replace("/", "~1")


def mistakes(schema, example, pointer=""):
    """(what, pointer, change) of requests that the schema excludes: change(value) makes one of a part of the example."""
    schema = resolved(schema)
    if "anyOf" in schema:
        fitting = [each for each in schema["anyOf"] if not errors_of(example, each, False)]
        for each in fitting[:1]:
            yield from mistakes(each, example, pointer)
        return
    if schema.get("type") == "array" and isinstance(example, list):
        for i, item in enumerate(example):
            if isinstance(item, (dict, list)):
                for what, at, change in mistakes(schema["items"], item, f"{pointer}/{i}"):
                    yield what, at, lambda value, i=i, change=change: value[:i] + [change(value[i])] + value[i + 1:]
        return
    if schema.get("type") != "object" or not isinstance(example, dict):
        return
    if schema.get("additionalProperties") is False:
        yield "an unknown key", f"{pointer}/nonsense", lambda value: {**value, "nonsense": 1}
    for key in schema.get("required", []):
        yield f"no {key}", f"{pointer}/{key}", lambda value, key=key: {k: v for k, v in value.items() if k != key}
    for key, member in schema.get("properties", {}).items():
        at = f"{pointer}/{escaped(key)}"
        for wrong in wrong_values(member):
            yield f"{key} = {json.dumps(wrong)[:40]}", at, lambda value, key=key, wrong=wrong: {**value, key: wrong}
        if key in example:
            for what, inner, change in mistakes(member, example[key], at):
                yield what, inner, lambda value, key=key, change=change: {**value, key: change(value[key])}


def query_mistakes(schema):
    schema = resolved(schema)
    kind = schema.get("type")
    if kind == "array":
        yield from query_mistakes(schema["items"])
    elif kind in ("number", "integer"):
        yield "x"
        for limit, beyond in (("minimum", -1), ("exclusiveMinimum", 0), ("maximum", 1), ("exclusiveMaximum", 0)):
            if limit in schema and schema[limit] < 1e15:
                yield str(schema[limit] + beyond * max(1, abs(schema[limit]) * 1e-3))
    elif "enum" in schema:
        yield "nonsense"
    elif "maxLength" in schema:
        yield "x" * (schema["maxLength"] + 1)


def body_of(path, content_type="application/json"):
    return document["paths"][path]["post"]["requestBody"]["content"][content_type]["example"]


fit = send("POST", "/v1/fits", body_of("/v1/fits"), "application/json", Prefer="wait=60").json()
dataset = send("POST", "/v1/datasets", body_of("/v1/datasets"), "application/json").json()
known = {"/v1/fits/{id}": fit["id"], "/v1/datasets/{id}": dataset["id"]}
order = {"DELETE": 1}
for method, path, operation in sorted(operations, key=lambda each: order.get(each[0], 0)):
    name = f"{method} {path}"
    parameters = operation.get("parameters", [])
    place = path
    for p in parameters:
        if p["in"] == "path":
            value = next((v for k, v in known.items() if p["name"] == "id" and path.startswith(k)), p.get("example"))
            place = place.replace("{" + p["name"] + "}", urllib.parse.quote(value))
    headers = {p["name"]: p["example"] for p in parameters if p["in"] == "header" and "example" in p}
    queries = [p for p in parameters if p["in"] == "query"]

    contents = operation.get("requestBody", {}).get("content", {None: {}})
    for content_type, content in contents.items():
        check(content_type is None or "example" in content, f"{name}: {content_type} has an example")
        answer = send(method, place, content.get("example"), content_type, **headers)
        check(200 <= answer.status < 300, f"{name} of {content_type} succeeds", f"{answer.status} {answer.body[:300]}")
        documented(name, operation, answer)
        check(answer.headers["X-Request-Id"] and answer.headers["X-Content-Type-Options"] == "nosniff", f"{name}: headers")
        forms = operation["responses"].get("200", {}).get("content", {})
        for form in forms if method == "GET" and len(forms) > 1 else []:
            by_accept = send(method, place, Accept=form)
            check(by_accept.type == form, f"{name}: {form} by Accept", by_accept.type)
            documented(name, operation, by_accept)
        if "304" in operation["responses"]:
            again = send(method, place, If_None_Match=answer.headers["ETag"])
            check(again.status == 304 and not again.body, f"{name}: not modified", again.status)
        if "406" in operation["responses"]:
            refused(f"{name}: Accept leaves nothing", send(method, place, Accept="image/png"), 406)

        if path == "/metrics":  # which heeds no query
            pass
        elif content_type != "application/json":
            for wrong in ("/?nonsense=1", *(f"/?{p['name']}={urllib.parse.quote(v)}" for p in queries
                                            for v in query_mistakes(p["schema"]))):
                key = wrong[2:].split("=")[0]
                answer = send(method, place + wrong[1:], content.get("example"), content_type)
                refused(f"{name}{wrong[1:60]}", answer, 400 if key == "cursor" else 422)
                pointers = [e["pointer"] for e in answer.json().get("errors", [])] if answer.type.endswith("json") else []
                check(any(re.search(rf"/{key}(/\d+)?$", each) for each in pointers), f"{name}{wrong[1:60]}: its place", pointers)
        else:
            for what, pointer, change in mistakes(content["schema"], content["example"]):
                request = change(copy.deepcopy(content["example"]))
                refused(f"{name}: {what}", send(method, place, request, content_type), 422, pointer)
        if content_type:
            refused(f"{name}: another type", send(method, place, "x", "text/plain"), 415)
            refused(f"{name}: no JSON", send(method, place, "{", "application/json"), 400)
    if any(p["name"] == "If-Match" for p in parameters) and method != "DELETE":
        refused(f"{name}: of another state", send(method, place, "" if method == "POST" else None, If_Match='"x"'), 412)
    for p in parameters:
        if p["in"] == "path":
            other = path.replace("{" + p["name"] + "}", "nonsense").replace("{id}", known.get(path[:path.find("}") + 1], "x"))
            answer = send(method, other, contents.get("application/json", {}).get("example"), next(iter(contents)))
            refused(f"{name}: no such {p['name']}", answer, 404)
    refused(f"PATCH {path}", send("PATCH", place, "{}", "application/json"), 405)

for path in known:
    gone = send("GET", path.replace("{id}", known[path]))
    refused(f"GET {path} after DELETE", gone, 410 if "fits" in path else 404)
for type_name in components["Problem"]["properties"]["type"]["enum"]:
    answer = send("GET", type_name)
    check(answer.status == 200 and answer.json()["type"] == type_name, f"{type_name} leads to its meaning", answer.body)

print(f"{counts[True]} passed, {counts[False]} failed")
sys.exit(counts[False] > 0)
