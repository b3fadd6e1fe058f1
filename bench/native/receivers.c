/* Many websocket clients in one process, quick enough never to be what is measured.
 *
 *   receivers PORT COUNT HEAD FRAMES RATE COME_AGAIN EVERY
 *
 * HEAD        file with the HTTP request that opens a websocket
 * FRAMES      file with what each client sends then: masked frames, ready made
 * RATE        bytes a second each client reads; 0: all there is, -1: none
 * COME_AGAIN  1: who is cut connects again after a second; 0: it stays away
 * EVERY       milliseconds after which is looked again for what has come; 0: at once when something comes. To wake
 *             somebody is work of the sender's processor; who looks by himself costs no sender anything
 *
 * Prints "READY" when all are connected. A line on the standard input is answered by one line of JSON: what has come
 * since the line before. Ends with the standard input. Pings are answered. Messages that hold "#<number>" in their first
 * 512 bytes are followed for gaps and order, by client and topic; "@<nanoseconds>" after it, by the monotonic clock,
 * says when they were published.
 */
#define _GNU_SOURCE
#include <arpa/inet.h>
#include <errno.h>
#include <fcntl.h>
#include <math.h>
#include <netinet/tcp.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/epoll.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

#define TOPICS 16
#define NAME 64
#define HEAD_BYTES 512
#define CHUNK (256 * 1024)
#define PER_ADDRESS 400
#define BUCKETS 256

struct topic {
    char name[NAME];
    long last;
    long messages, lost, disorder;
};

struct client {
    int fd;
    double again_at, tokens;
    unsigned char header[14];
    int header_have;
    uint64_t left;
    int opcode;
    unsigned char start[HEAD_BYTES];
    size_t start_have;
    long messages, bytes;
    int topic_count;
    struct topic topics[TOPICS];
};

static struct client *clients;
static int count, port, come_again, every, poller;
static double rate;
static char *head, *frames;
static size_t head_size, frames_size;
static long cuts;
static long delays[BUCKETS], delay_count;
static double delay_most;
static unsigned char chunk[CHUNK];

static void die(const char *what) {
    perror(what);
    exit(1);
}

static double now(void) {
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec + t.tv_nsec / 1e9;
}

static char *file(const char *path, size_t *size) {
    FILE *f = fopen(path, "rb");
    if (!f) die(path);
    fseek(f, 0, SEEK_END);
    *size = ftell(f);
    rewind(f);
    char *content = malloc(*size + 1);
    if (fread(content, 1, *size, f) != *size) die(path);
    fclose(f);
    content[*size] = 0;
    return content;
}

static struct topic *topic_of(struct client *c, const char *name, size_t length) {
    for (int i = 0; i < c->topic_count; i++)
        if (strlen(c->topics[i].name) == length && !memcmp(c->topics[i].name, name, length)) return &c->topics[i];
    if (c->topic_count == TOPICS || length >= NAME) return NULL;
    struct topic *t = &c->topics[c->topic_count++];
    memset(t, 0, sizeof *t);
    memcpy(t->name, name, length);
    t->last = -1;
    return t;
}

static void late_by(double sent_ns) {
    double us = now() * 1e6 - sent_ns / 1e3;
    int bucket = us <= 1 ? 0 : (int)(8 * log2(us));
    delays[bucket >= BUCKETS ? BUCKETS - 1 : bucket]++;
    delay_count++;
    if (us > delay_most) delay_most = us;
}

static void message(struct client *c) {
    c->messages++;
    char *text = (char *)c->start;
    text[c->start_have < HEAD_BYTES ? c->start_have : HEAD_BYTES - 1] = 0;
    char *name = strstr(text, "\"topic\":");
    char *mark = strchr(text, '#');
    if (!name || !mark) return;
    name += 8;
    while (*name == ' ' || *name == '"') name++;
    char *end = strchr(name, '"');
    if (!end) return;
    struct topic *t = topic_of(c, name, end - name);
    if (!t) return;
    char *after;
    long number = strtol(mark + 1, &after, 10);
    t->messages++;
    if (t->last >= 0 && number > t->last + 1) t->lost += number - t->last - 1;
    if (number <= t->last) t->disorder++;
    t->last = number;
    if (*after == '@') late_by(strtod(after + 1, NULL));
}

static void shut(struct client *c) {
    if (c->fd >= 0) close(c->fd);
    c->fd = -1;
    c->again_at = now() + 1;
    cuts++;
}

static void pong(struct client *c) {
    unsigned char answer[131] = {0x8A, 0x80 | (unsigned char)c->start_have, 0, 0, 0, 0};
    memcpy(answer + 6, c->start, c->start_have);
    if (send(c->fd, answer, 6 + c->start_have, MSG_NOSIGNAL) < 0) shut(c);
}

static void whole(struct client *c) {
    if (c->opcode == 1 || c->opcode == 2 || c->opcode == 0) message(c);
    else if (c->opcode == 9 && c->start_have <= 125) pong(c);
    else if (c->opcode == 8) shut(c);
}

static void parse(struct client *c, const unsigned char *data, size_t size) {
    c->bytes += size;
    while (size && c->fd >= 0) {
        if (c->left) {
            size_t take = size < c->left ? size : c->left;
            size_t keep = HEAD_BYTES - 1 - c->start_have;
            if (keep > take) keep = take;
            memcpy(c->start + c->start_have, data, keep);
            c->start_have += keep;
            data += take;
            size -= take;
            c->left -= take;
            if (!c->left) whole(c);
            continue;
        }
        c->header[c->header_have++] = *data++;
        size--;
        if (c->header_have < 2) continue;
        int length = c->header[1] & 127, need = 2 + (length == 126 ? 2 : length == 127 ? 8 : 0);
        if (c->header_have < need) continue;
        uint64_t left = length;
        if (length >= 126) {
            left = 0;
            for (int i = 2; i < need; i++) left = left << 8 | c->header[i];
        }
        c->opcode = c->header[0] & 15;
        c->left = left;
        c->start_have = 0;
        c->header_have = 0;
        if (!left) whole(c);
    }
}

static void come(struct client *c, int index, int first) {
    int one = 1, small = 4096;
    struct sockaddr_in from = {.sin_family = AF_INET};
    struct sockaddr_in to = {.sin_family = AF_INET, .sin_port = htons(port), .sin_addr.s_addr = htonl(INADDR_LOOPBACK)};
    struct timeval patience = {.tv_sec = 20};
    char answer[4096];
    size_t got = 0;
    int fd = socket(AF_INET, SOCK_STREAM | SOCK_CLOEXEC, 0);
    if (fd < 0) die("socket");
    from.sin_addr.s_addr = htonl((127u << 24) + 2 + index / PER_ADDRESS);
    if (bind(fd, (struct sockaddr *)&from, sizeof from)) die("bind");
    if (rate != 0) setsockopt(fd, SOL_SOCKET, SO_RCVBUF, &small, sizeof small);
    setsockopt(fd, SOL_SOCKET, SO_RCVTIMEO, &patience, sizeof patience);
    setsockopt(fd, IPPROTO_TCP, TCP_NODELAY, &one, sizeof one);
    c->fd = fd;
    c->left = 0;
    c->header_have = 0;
    for (int i = 0; i < c->topic_count; i++) c->topics[i].last = -1;
    if (connect(fd, (struct sockaddr *)&to, sizeof to) || send(fd, head, head_size, MSG_NOSIGNAL) < 0) goto failed;
    char *end = NULL;
    while (!end && got < sizeof answer - 1) {
        ssize_t n = recv(fd, answer + got, sizeof answer - 1 - got, 0);
        if (n <= 0) goto failed;
        got += n;
        answer[got] = 0;
        end = strstr(answer, "\r\n\r\n");
    }
    if (strncmp(answer, "HTTP/1.1 101", 12)) goto failed;
    if (frames_size && send(fd, frames, frames_size, MSG_NOSIGNAL) != (ssize_t)frames_size) goto failed;
    fcntl(fd, F_SETFL, O_NONBLOCK);
    if (rate == 0) {
        struct epoll_event event = {.events = EPOLLIN, .data.u32 = index};
        if (epoll_ctl(poller, EPOLL_CTL_ADD, fd, &event)) die("epoll_ctl");
    }
    parse(c, (unsigned char *)end + 4, got - (end + 4 - answer));
    return;
failed:
    if (first) {
        fprintf(stderr, "client %d could not connect: %.200s\n", index, got ? answer : strerror(errno));
        exit(1);
    }
    shut(c);
}

static int take(struct client *c, size_t most) {
    ssize_t n = recv(c->fd, chunk, most < CHUNK ? most : CHUNK, 0);
    if (n == 0 || (n < 0 && errno != EAGAIN && errno != EINTR)) {
        shut(c);
        return 0;
    }
    if (n <= 0) return 0;
    parse(c, chunk, n);
    return n;
}

/* Every 50 ms: the slow read what they may, the stalled notice whether they were cut, those cut come again. */
static void tick(double passed) {
    for (int i = 0; i < count; i++) {
        struct client *c = &clients[i];
        if (c->fd < 0) {
            if (come_again && now() > c->again_at) come(c, i, 0);
        } else if (rate > 0) {
            c->tokens += rate * passed;
            if (c->tokens > rate) c->tokens = rate;
            if (c->tokens >= 1) c->tokens -= take(c, c->tokens);
        } else if (rate < 0) {
            int error = 0;
            socklen_t size = sizeof error;
            struct tcp_info info;
            socklen_t info_size = sizeof info;
            getsockopt(c->fd, SOL_SOCKET, SO_ERROR, &error, &size);
            getsockopt(c->fd, IPPROTO_TCP, TCP_INFO, &info, &info_size);
            if (error || info.tcpi_state != TCP_ESTABLISHED) shut(c);
        }
    }
}

static double delay_at(double part) {
    long seen = 0;
    for (int i = 0; i < BUCKETS; i++) {
        seen += delays[i];
        if (seen > delay_count * part) return pow(2, (i + 0.5) / 8);
    }
    return delay_most;
}

static void tell(void) {
    long messages = 0, bytes = 0, least = -1, most = 0, open = 0;
    struct topic all[TOPICS * 4];
    long fewest[TOPICS * 4];
    int names = 0;
    for (int i = 0; i < count; i++) {
        struct client *c = &clients[i];
        messages += c->messages;
        bytes += c->bytes;
        open += c->fd >= 0;
        if (least < 0 || c->messages < least) least = c->messages;
        if (c->messages > most) most = c->messages;
        c->messages = c->bytes = 0;
        for (int j = 0; j < c->topic_count; j++) {
            struct topic *t = &c->topics[j];
            int k = 0;
            while (k < names && strcmp(all[k].name, t->name)) k++;
            if (k == TOPICS * 4) continue;
            if (k == names) {
                memset(&all[k], 0, sizeof all[k]);
                memcpy(all[k].name, t->name, NAME);
                fewest[k] = t->messages;
                names++;
            }
            all[k].messages += t->messages;
            all[k].lost += t->lost;
            all[k].disorder += t->disorder;
            if (t->messages < fewest[k]) fewest[k] = t->messages;
            t->messages = t->lost = t->disorder = 0;
        }
    }
    printf("{\"open\":%ld,\"cuts\":%ld,\"messages\":%ld,\"bytes\":%ld,\"least\":%ld,\"most\":%ld,", open, cuts, messages,
           bytes, least, most);
    printf("\"delay_us\":{\"count\":%ld,\"p50\":%.1f,\"p99\":%.1f,\"most\":%.1f},\"topics\":{", delay_count, delay_at(0.5),
           delay_at(0.99), delay_most);
    for (int k = 0; k < names; k++)
        printf("%s\"%s\":{\"messages\":%ld,\"least\":%ld,\"lost\":%ld,\"disorder\":%ld}", k ? "," : "", all[k].name,
               all[k].messages, fewest[k], all[k].lost, all[k].disorder);
    printf("}}\n");
    fflush(stdout);
    cuts = delay_count = 0;
    delay_most = 0;
    memset(delays, 0, sizeof delays);
}

static int serve(int wait_ms, int asked) {
    struct epoll_event events[256];
    int n = epoll_wait(poller, events, 256, wait_ms);
    if (n < 0 && errno != EINTR) die("epoll_wait");
    for (int i = 0; i < n; i++) {
        if (events[i].data.u32 == UINT32_MAX) {
            char line[64];
            if (!asked) continue;
            if (read(STDIN_FILENO, line, sizeof line) <= 0) exit(0);
            tell();
        } else {
            struct client *c = &clients[events[i].data.u32];
            if (c->fd >= 0) take(c, CHUNK);
        }
    }
    return n;
}

int main(int argc, char **argv) {
    if (argc != 8) {
        fprintf(stderr, "receivers PORT COUNT HEAD FRAMES RATE COME_AGAIN EVERY\n");
        return 2;
    }
    port = atoi(argv[1]);
    count = atoi(argv[2]);
    head = file(argv[3], &head_size);
    frames = file(argv[4], &frames_size);
    rate = atof(argv[5]);
    come_again = atoi(argv[6]);
    every = atoi(argv[7]);
    clients = calloc(count, sizeof *clients);
    poller = epoll_create1(EPOLL_CLOEXEC);
    struct epoll_event event = {.events = EPOLLIN, .data.u32 = UINT32_MAX};
    for (int i = 0; i < count; i++) {
        come(&clients[i], i, 1);
        serve(0, 0);
    }
    if (epoll_ctl(poller, EPOLL_CTL_ADD, STDIN_FILENO, &event)) die("epoll_ctl");
    printf("READY\n");
    fflush(stdout);
    double last = now();
    for (;;) {
        if (every) {
            usleep(every * 1000);
            while (serve(0, 1) > 0) continue;
        } else {
            serve(50, 1);
        }
        double t = now();
        if (t - last >= 0.05) {
            tick(t - last);
            last = t;
        }
    }
}
