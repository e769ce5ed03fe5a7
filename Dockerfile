# The lab in a container, for an ordinary user:
#
#     docker build -t stad_lab .
#     docker run --rm -p 127.0.0.1:8888:8888 stad_lab
#
# Then open the printed address that begins with http://127.0.0.1.
FROM python:3.12-slim

# Other users may enter the home: a grader runs submissions under an id of its own.
RUN useradd --create-home --uid 1000 driver && chmod 755 /home/driver
USER driver
WORKDIR /home/driver/stad_lab

# PyTorch without CUDA saves gigabytes. It changes seldom, so it has a layer of its own.
RUN python -m venv .venv \
    && .venv/bin/pip install --no-cache-dir torch==2.13.0 --index-url https://download.pytorch.org/whl/cpu
COPY --chown=driver . .
RUN .venv/bin/pip install --no-cache-dir -r environment.txt && .venv/bin/python -m stad_course doctor

ENV PATH=/home/driver/stad_lab/.venv/bin:$PATH
EXPOSE 8888
CMD ["jupyter", "lab", "--ip=0.0.0.0", "--no-browser", "--LabApp.default_url=/lab/tree/notebooks"]
