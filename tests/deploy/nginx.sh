#!/usr/bin/env bash
# deploy/nginx.conf with a certificate of its own, on free ports, before a server.
. "$(dirname "${BASH_SOURCE[0]}")/../http/lib.sh"
command -v nginx >/dev/null || { fail "nginx is there"; finish; }
require_server
openssl req -x509 -newkey rsa:2048 -nodes -days 2 -subj /CN=localhost -addext subjectAltName=DNS:localhost \
    -keyout "$work/brdfit.key" -out "$work/brdfit.pem" 2>/dev/null
port=$(python3 -c 'import socket; s = socket.socket(); s.bind(("127.0.0.1", 0)); print(s.getsockname()[1])')
backend=$url
mkdir "$work/temp"
{
    echo "daemon off; pid $work/nginx.pid; error_log $work/error.log; events {}"
    [[ $EUID != 0 ]] || echo "user root;"
    echo "http { access_log off; client_body_temp_path $work/temp/1; proxy_temp_path $work/temp/2;"
    echo "fastcgi_temp_path $work/temp/3; uwsgi_temp_path $work/temp/4; scgi_temp_path $work/temp/5;"
    sed -e "s|/etc/ssl/certs/brdfit.pem|$work/brdfit.pem|; s|/etc/ssl/private/brdfit.key|$work/brdfit.key|" \
        -e "s|127.0.0.1:8080|${backend#http://}|; s|listen 443|listen 127.0.0.1:$port|; /listen \[::\]/d" \
        "$repository/deploy/nginx.conf"
    echo "}"
} >"$work/nginx.conf"
nginx -p "$work" -c "$work/nginx.conf" >"$work/nginx.log" 2>&1 &
servers+=($!)
url=https://localhost:$port
tls=(--cacert "$work/brdfit.pem" --noproxy '*' --resolve "localhost:$port:127.0.0.1")
for _ in {1..100}; do
    request GET /health/live "${tls[@]}"
    [[ $status != 000 ]] && break
    sleep 0.1
done
answered "live, over TLS" 200
post_csv models=lambert "$samples/white_plastic.csv" "${tls[@]}"
answered "a fit" 200
get /v1/models "${tls[@]}" --compressed
answered "models" 200
check_equal "... compressed" "$(header Content-Encoding)" gzip
get /nothing "${tls[@]}"
refused "a refusal passes through" 404
check "its id is nginx's" grep -qE '^[0-9a-f]{32}$' <<<"$(header X-Request-Id)"
get /metrics "${tls[@]}"
answered "metrics are not for others" 404
for _ in {1..200}; do printf 'url = "%s/health/live"\noutput = /dev/null\n' "$url"; done >"$work/many"
check_equal "200 requests over kept connections" \
    "$(curl -sS "${tls[@]}" -K "$work/many" -w '%{http_code}\n' | sort | uniq -c | xargs)" "200 200"
check "nginx has nothing to complain about" test -z "$(grep -v 'ssl_stapling' "$work/error.log")"
finish
